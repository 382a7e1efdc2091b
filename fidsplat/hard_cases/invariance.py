"""Pictures that must have the same bits: drawn again, in tiles of another size, without what is not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from types import ModuleType

import numpy as np

from fidsplat.backends.view import View
from fidsplat.effects import select
from fidsplat.hard_cases.agreement import Picture
from fidsplat.render import Frame, Renderer

CULLED = 0xFFFFFFFF
"""depth key of a splat that is not drawn, on devices"""


def draw(renderer: Renderer, picture: Picture) -> Frame:
    """The picture on a device."""
    return renderer.render(
        picture.cloud, picture.camera, picture.outputs, picture.quality, picture.background
    )


def trace(renderer: Renderer, picture: Picture, shape=None) -> dict[str, np.ndarray]:
    """What passes between the stages of a device, with the planes; `shape` replaces its build constants."""
    features = select(picture.cloud, picture.outputs, picture.quality)
    view = View.of(picture.camera, picture.quality, picture.cloud.origin, picture.background)
    backend = renderer.backend
    pipeline = backend.pipeline(features) if shape is None else backend.pipeline(features, shape)  # type: ignore[call-arg]
    return pipeline.trace(backend.upload(picture.cloud), view)


def differing(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray], outputs) -> int:
    """Number of pixels whose bits differ in any of the outputs; all of them where the shapes differ."""
    different = np.zeros((), bool)
    for name in outputs:
        one, other = (np.ascontiguousarray(planes[name]) for planes in (first, second))
        if one.shape != other.shape:
            return max(one.size, other.size)
        bits = f"u{one.itemsize}"
        unlike = one.view(bits) != other.view(bits)
        different = different | (unlike.any(-1) if unlike.ndim == 3 else unlike)
    return int(different.sum())


def out_of_order(traced: Mapping[str, np.ndarray], wanted: np.ndarray) -> int:
    """How many splats of a trace do not follow the order `wanted` (visible,), in tiles' lists or at all."""
    if "lists" not in traced:
        return int((traced["order"] != wanted).sum())
    rank = np.full(len(traced["keys"]), -1)
    rank[wanted] = np.arange(len(wanted))
    places, starts = rank[traced["lists"]], traced["starts"].astype(np.int64)
    follows = np.ones(len(places), bool)  # the one before it in the same list
    follows[starts[:-1][starts[:-1] < len(places)]] = False
    return int((places < 0).sum() + (follows[1:] & (np.diff(places) <= 0)).sum())


def has_tiles(renderer: Renderer) -> bool:
    """Whether the device draws in tiles whose size can be chosen."""
    return hasattr(renderer.backend, "shape")


def tile_shapes(renderer: Renderer) -> list:
    """Build constants with other tiles: 8, 16 and 32 pixels where the schedule has them."""
    own = renderer.backend.shape  # type: ignore[attr-defined]
    if own.schedule == "lanes":
        # a tile is as wide as the vector; a scalar exp may round otherwise than a vector one
        sizes = [(lanes, height) for lanes, height in ((8, 8), (own.lanes, 32), (4, 16))]
        return [replace(own, lanes=w, tile_width=w, tile_height=h) for w, h in sizes]
    return [replace(own, tile_width=side, tile_height=side) for side in (8, 32)]


def group_shape(own, side: int):
    """Build constants `own` with the schedule that a GPU would be given, in tiles of side x side."""
    groups = replace(own, schedule="group", tile_width=side, tile_height=side)
    return replace(groups, lists="tiled", lanes=1, scan_items=64) if hasattr(own, "lists") else groups


def other_schedule(renderer: Renderer):
    """Build constants of the schedule for GPUs; on a GPU, with other tiles."""
    return group_shape(renderer.backend.shape, 8)  # type: ignore[attr-defined]


def odd_shapes(renderer: Renderer) -> list:
    """The device's build constants, and others for its sorting where it has its own."""
    own = renderer.backend.shape  # type: ignore[attr-defined]
    if not hasattr(own, "chunks"):
        return [own]
    return [own, replace(own, chunks=7, radix_bits=5), group_shape(own, 16)]


def probe_of(renderer: Renderer) -> ModuleType | None:
    """The module that looks into the renderer's device; None for the reference."""
    family = renderer.device.name.split(":")[0]
    return None if family == "reference" else import_module(f"fidsplat.backends.{family}.probe")
