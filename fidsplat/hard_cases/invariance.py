"""Pictures that must have the same bits: drawn again, in tiles of another size, without what is not seen."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fidsplat.backends.base import Reshapes
from fidsplat.hard_cases.agreement import Picture
from fidsplat.render import Renderer

CULLED = 0xFFFFFFFF
"""depth key of a splat that is not drawn, on devices"""


def trace(renderer: Renderer, picture: Picture, shape=None) -> dict[str, np.ndarray]:
    """What passes between the stages of a device, with the outputs; `shape` replaces its build constants."""
    features, view = picture.prepared()
    backend = renderer.backend
    if shape is not None and isinstance(backend, Reshapes):
        pipeline = backend.pipeline(features, shape)
    else:
        pipeline = backend.pipeline(features)
    return pipeline.trace(backend.upload(picture.cloud), view)


def differing(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray], outputs) -> int:
    """Number of pixels whose bits differ in any of the outputs; all of them where the shapes differ."""
    different = np.zeros((), bool)
    for name in outputs:
        one, other = (np.ascontiguousarray(images[name]) for images in (first, second))
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
