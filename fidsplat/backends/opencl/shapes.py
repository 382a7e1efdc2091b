"""Build constants of a device: those of one picture, and others that tests hold against them."""

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


def other_shapes(own: DeviceShape, kind: str) -> dict[str, DeviceShape]:
    """Build constants by name, for tests: `Reshapes.shapes` of fidsplat/backends/base.py."""
    if kind == "schedule":
        return {"groups": _groups(own, 8)}
    if kind == "sorting":
        return {"own": own, "in 7 pieces": replace(own, chunks=7, radix_bits=5), "groups": _groups(own, 16)}
    sizes = [(8, 8), (32, 32)]
    if own.schedule == "lanes":
        # a tile is as wide as the vector
        sizes = [(8, 8), (own.lanes, 32), (4, 16)]
    lanes = [{"lanes": width} if own.schedule == "lanes" else {} for width, _ in sizes]
    return {
        f"{width} x {height}": replace(own, tile_width=width, tile_height=height, **lane)
        for (width, height), lane in zip(sizes, lanes, strict=True)
    }


def _groups(own: DeviceShape, side: int) -> DeviceShape:
    """The schedule of a GPU in tiles of side x side."""
    groups = replace(own, schedule="group", tile_width=side, tile_height=side)
    return replace(groups, lists="tiled", lanes=1, scan_items=64)
