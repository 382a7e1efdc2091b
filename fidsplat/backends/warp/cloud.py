"""Clouds on a Warp device: uploaded, or wrapped arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.cloud_arrays import kernel_arrays
from fidsplat.backends.interface import DeviceCloud
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import ArrayPool, nbytes
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import MAX_DEGREE, color_range
from fidsplat.util.errors import DeviceError, InputError, bytes_words


class WarpCloud(DeviceCloud):
    def __init__(
        self,
        arrays: dict[str, Any],
        count: int,
        origin: np.ndarray,
        sh_degree: int,
        footprint: str = "gaussian",
        ellipsoids: str = "none",
    ) -> None:
        self.arrays, self.count, self.origin = arrays, count, origin
        self.memory_bytes = sum(map(nbytes, arrays.values()))
        """bytes on the device, including wrapped arrays"""
        self.sh_degree, self.has_coplanar_groups = sh_degree, "coplanar_groups" in arrays
        self.footprint, self.ellipsoids = footprint, ellipsoids
        self.wraps_arrays = False
        """whether the caller may change the arrays"""

    def color_range(self) -> tuple[float, float]:
        """Lower and upper bound of every channel, from any direction, for the current values."""
        colors = self.arrays["colors"].numpy()[: self.count * max(self.sh_degree + 1, 1) ** 2]
        if self.sh_degree > 0:
            return color_range(None, colors.reshape(self.count, -1, 3))
        return color_range(colors, None)

    @classmethod
    def of(cls, cloud: SplatCloud, pool: ArrayPool) -> WarpCloud:
        arrays = kernel_arrays(cloud)
        if "sh" in arrays:
            arrays["colors"] = arrays.pop("sh").reshape(-1, 3)
        if cloud.footprint != "mixed":
            arrays.pop("boxes", None)
        device = {name: _uploaded(name, array, pool) for name, array in arrays.items()}
        kinds = cloud.footprint, cloud.ellipsoids
        return cls(device, len(cloud), cloud.origin, cloud.sh_degree, *kinds)

    @classmethod
    def around(cls, given: Mapping[str, Any], origin: np.ndarray, pool: ArrayPool) -> WarpCloud:
        """Use arrays of the device or of NumPy. Raises InputError for a wrong shape, type or device."""
        arrays, ellipsoids = {name: _adopted(name, value, pool) for name, value in given.items()}, "none"
        count = arrays["means"].size
        if count and arrays["scales"].dtype is load().vec3:
            arrays |= split_scales(arrays["scales"])
            ellipsoids = "some"  # the kernels decide for each splat
        terms = 0
        if "sh" in arrays:
            arrays["colors"] = arrays.pop("sh")
            terms = arrays["colors"].size // max(count, 1)
            known = [(degree + 1) ** 2 for degree in range(1, MAX_DEGREE + 1)]
            if count and terms not in known:
                raise InputError(
                    f"the number of sh coefficients per splat must be one of {known}, got {terms}"
                )
        if "labels" not in arrays:
            arrays["labels"] = pool.allocate("labels", count, load().int32)
            arrays["labels"].zero_()
        for name, array in arrays.items():
            expected = count * max(terms, 1) if name == "colors" else count
            if count and array.size != expected:
                raise InputError(f"{name} must have {expected} elements for {count} means, got {array.size}")
        sh_degree = int(np.sqrt(terms)) - 1 if terms else -1
        cloud = cls(arrays, count, origin, sh_degree, ellipsoids=ellipsoids)
        cloud.wraps_arrays = True
        return cloud


def _dtype(name: str) -> Any:
    wp = load()

    return {
        "means": wp.vec3,
        "quats": wp.vec4,
        "scales": wp.vec2,
        "opacities": wp.float32,
        "colors": wp.vec3,
        "sh": wp.vec3,
        "labels": wp.int32,
        "coplanar_groups": wp.int32,
        "boxes": wp.int32,
        "thickness": wp.float32,
    }[name]


def split_scales(scales: Any) -> dict[str, Any]:
    """Split an array of three scales into views of scales and thickness."""
    wp = load()

    def part(first: int, dtype: Any) -> Any:
        at = scales.ptr + first * wp.types.type_size_in_bytes(wp.float32)
        shape, strides = scales.shape, scales.strides
        view = wp.array(ptr=at, dtype=dtype, shape=shape, strides=strides, device=scales.device)
        view._ref = scales  # keeps the memory alive
        return view

    return {"scales": part(0, wp.vec2), "thickness": part(2, wp.float32)}


def _uploaded(name: str, array: np.ndarray, pool: ArrayPool, dtype: Any = None) -> Any:
    wp = load()

    dtype = dtype or _dtype(name)
    if array.size == 0:
        return pool.allocate(name, 1, dtype)
    try:
        return wp.array(np.ascontiguousarray(array), dtype=dtype, device=pool.device).flatten()
    except (RuntimeError, MemoryError) as error:
        raise DeviceError(
            f"the cloud's {name} must fit the memory of {pool.device}, got "
            f"{bytes_words(array.nbytes)}; use fewer splats"
        ) from error


def _is_thick(scales: Any) -> bool:
    """Whether an array of any library has three scales per splat."""
    wp = load()
    if isinstance(scales, wp.array) and scales.ndim == 1:
        return wp.types.type_size(scales.dtype) == 3
    shape = tuple(scales.shape) if hasattr(scales, "shape") else np.shape(scales)
    return len(shape) > 1 and shape[-1] == 3


def _adopted(name: str, value: Any, pool: ArrayPool) -> Any:
    """Convert one array to the element type of the kernels, sharing the memory of `value` if possible."""
    wp = load()

    dtype = wp.vec3 if name == "scales" and _is_thick(value) else _dtype(name)
    scalar, width = (wp.int32, 1) if dtype is wp.int32 else (wp.float32, wp.types.type_size(dtype))
    if not isinstance(value, wp.array) and not hasattr(value, "__dlpack__"):
        value = np.asarray(value)
    if isinstance(value, np.ndarray):
        typed = value.astype(np.int32 if dtype is wp.int32 else np.float32, copy=False)
        if width > 1 and (typed.ndim < 2 or typed.shape[-1] != width):
            expected = "2 or 3" if name == "scales" else width
            raise InputError(f"the last axis of {name} must be {expected}, got shape {typed.shape}")
        return _uploaded(name, typed, pool, dtype)
    array: Any = value if isinstance(value, wp.array) else wp.from_dlpack(value)
    if array.device != pool.device:
        raise InputError(
            f"{name} must be on {pool.device}, the device of this renderer, got {array.device}; move it there"
        )
    if not array.is_contiguous:
        raise InputError(f"{name} must be contiguous, got strides {array.strides}; give a contiguous copy")
    if array.dtype == scalar and width > 1 and array.shape[-1] == width:
        array = wp.from_dlpack(array, dtype=dtype)
    if (
        wp.types.type_size(array.dtype) != width
        or getattr(array.dtype, "_wp_scalar_type_", array.dtype) != scalar
    ):
        raise InputError(
            f"an element of {name} must be {width} x {scalar.__name__}, got the type "
            f"{wp.types.type_repr(array.dtype)} and the shape {array.shape}"
        )
    return array.flatten()
