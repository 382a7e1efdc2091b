"""Build constants of a device for one picture: its own, changed where the picture's knobs ask for it."""

from __future__ import annotations

from dataclasses import replace

from fidsplat.backends.opencl.assemble import DeviceShape
from fidsplat.effects import FeatureSet


def shape_for(features: FeatureSet, shape: DeviceShape) -> DeviceShape:
    """`shape` with the tiles, the schedule and the sort's digits that these features ask for."""
    if "blend_double" in features.slots and shape.schedule == "lanes":
        # doubles are drawn one by one
        shape = replace(shape, schedule="group", lanes=1, tile_width=16, tile_height=16)
    if features.tile_size is not None:
        width = features.tile_size
        if shape.schedule == "lanes":
            width = min(width, shape.lanes)  # a row of a tile is one vector
            shape = replace(shape, lanes=width)
        shape = replace(shape, tile_width=width, tile_height=features.tile_size)
    if "keys_short" in features.slots:
        # as many passes as with digits that are a bit wider than the device's own, all of one width
        passes = -(-features.depth_key_bits // (shape.radix_bits + 1))
        shape = replace(shape, radix_bits=-(-features.depth_key_bits // passes))
    return shape
