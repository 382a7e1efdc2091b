"""Build constants of a device for one picture: its own, changed where the picture's knobs ask for it."""

from __future__ import annotations

from dataclasses import replace

from fidsplat.backends.opencl.assemble import DeviceShape
from fidsplat.effects import FeatureSet


def shape_for(features: FeatureSet, shape: DeviceShape) -> DeviceShape:
    """`shape` with the schedule and the tiles that these features ask for."""
    if "blend_double" in features.slots and shape.schedule == "lanes":
        # doubles are drawn one by one
        shape = replace(shape, schedule="group", lanes=1, tile_width=16, tile_height=16)
    return shape
