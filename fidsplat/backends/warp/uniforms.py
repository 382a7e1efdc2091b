"""The struct `View` of kernels/warp/common.py from a picture's view: each of its fields by its name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from fidsplat.backends.view import View
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.shapes import WarpShape


def _ray(view: View) -> tuple[float, ...]:
    focal_x, focal_y, center_x, center_y = view.uniform("ray")
    return 1 / focal_x, 1 / focal_y, center_x, center_y


_DERIVED: dict[str, Callable[[View, WarpShape], Any]] = {
    "per_focal_x": lambda view, shape: 1.0 / view.focal_x,
    "per_focal_y": lambda view, shape: 1.0 / view.focal_y,
    "per_near": lambda view, shape: 1.0 / view.near,
    "tile_w": lambda view, shape: shape.tile_width,
    "tile_h": lambda view, shape: shape.tile_height,
    "tiles_x": lambda view, shape: -(-view.width // shape.tile_width),
    "tiles_y": lambda view, shape: -(-view.height // shape.tile_height),
    "per_pixel": lambda view, shape: 1.0 / view.samples**2,
    "ray_step": lambda view, shape: 0.0,
    "ray": lambda view, shape: _ray(view),
}
"""fields that a view does not have by their names"""


@cache
def _fields() -> tuple[tuple[str, Any, Any], ...]:
    """Name of each field, where it comes from if it is derived, and its type if it is a vector or matrix."""
    types = load().types
    kinds = {name: field.type for name, field in kernels("common").View.vars.items()}
    wide = {name for name, kind in kinds.items() if types.type_is_vector(kind) or types.type_is_matrix(kind)}
    return tuple((name, _DERIVED.get(name), kind if name in wide else None) for name, kind in kinds.items())


def uniforms(view: View, shape: WarpShape, sloped: bool) -> Any:
    """The struct for a picture in tiles of this shape; sloped: its kernels read rays' derivatives."""
    filled = kernels("common").View()
    for name, derive, wide in _fields():
        value: Any = derive(view, shape) if derive else getattr(view, name)
        if wide:
            value = wide(*(value.ravel().tolist() if isinstance(value, np.ndarray) else value))
        setattr(filled, name, value)
    if sloped and view.raster:
        filled.ray_step = view.raster.step  # of which it takes long to ask
    return filled
