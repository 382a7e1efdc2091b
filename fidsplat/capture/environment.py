"""Environment of the splats: fog, backgrounds and external depth images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.util.arguments import (
    LARGEST,
    PickledByFields,
    array_of,
    python_scalars,
    three_numbers,
)
from fidsplat.util.errors import InputError

MAX_PANORAMA = 16384
"""maximum number of pixels per side"""


@dataclass(frozen=True)
class Fog:
    """Homogeneous fog: a surface at distance r contributes the share exp(-density r) of its colour, the fog's
    colour the rest. The fog's colour replaces the background."""

    density: float
    """1 / metres"""
    color: tuple[float, float, float] = (0.7, 0.7, 0.7)
    """RGB"""

    def __post_init__(self) -> None:
        python_scalars(self)
        ok = isinstance(self.density, (int, float)) and not isinstance(self.density, bool)
        if not (ok and 0 <= self.density <= LARGEST):
            raise InputError(
                f"fog: density must be a number of at least 0 (1 / metres), got {self.density!r}"
            )
        object.__setattr__(self, "color", three_numbers("fog: color", self.color))


@dataclass(frozen=True)
class Gradient:
    """Background gradient between two colours by the sine of the elevation of the ray.

    Raises InputError for a colour or direction that is not three finite numbers, or a direction of length 0.
    """

    top: tuple[float, float, float]
    """RGB straight up"""
    bottom: tuple[float, float, float]
    """RGB straight down"""
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    """world direction, of any length"""

    def __post_init__(self) -> None:
        for name in ("top", "bottom", "up"):
            object.__setattr__(self, name, three_numbers(f"background: {name}", getattr(self, name)))
        if not 0 < np.linalg.norm(self.up) < math.inf:
            raise InputError(f"background: up must be a direction, e.g. (0, -1, 0), got {self.up!r}")


@dataclass(frozen=True, eq=False)
class Panorama(PickledByFields):
    """Equirectangular background image: its middle column faces +z, +x is to its right, its top row is -y.

    Raises InputError for anything but an (h, w, 3) array of finite numbers with 2 to 16384 pixels a side.
    """

    image: np.ndarray
    """(h, w, 3) float32 RGB, read-only; uint8 is divided by 255, uint16 by 65535"""
    file: str | None = None
    """path of the image file"""

    def __post_init__(self) -> None:
        pixels = array_of("background: a panorama", self.image, "(h, w, 3) numbers", "fiu")
        if pixels.ndim != 3 or pixels.shape[2] != 3:
            raise InputError(f"background: a panorama must be (h, w, 3) numbers, got {pixels.shape}")
        if not 2 <= min(pixels.shape[:2]) <= max(pixels.shape[:2]) <= MAX_PANORAMA:
            height, width = pixels.shape[:2]
            raise InputError(
                f"background: a panorama must have 2 to {MAX_PANORAMA} pixels a side, got {width} x {height}"
            )
        white = np.iinfo(pixels.dtype).max if pixels.dtype in (np.uint8, np.uint16) else 1
        with np.errstate(over="ignore"):  # an overflow of float32 is rejected below
            image = np.array(pixels, np.float32, order="C") / np.float32(white)
        if invalid_count := np.count_nonzero(~np.isfinite(image)):
            which = f"the panorama {self.file}" if self.file else "the panorama"
            raise InputError(
                f"background: {which} must be finite, got {invalid_count:,} values that are NaN or infinite; "
                "replace them"
            )
        image.flags.writeable = False
        object.__setattr__(self, "image", image)

    @staticmethod
    def load(path) -> Panorama:
        """Read an image file of 8 or 16 bits or floats. Raises InputError if it cannot be read."""
        from fidsplat.images.files import read_image

        return Panorama(read_image(path, deep=True), str(path))


@dataclass(frozen=True, eq=False)
class ExternalDepth(PickledByFields):
    """Colour and depth image from another renderer, composited with the splats as an opaque surface.

    In each pixel the surface occludes the splats behind it, and splats in front are composited over it. If
    all views of a batch share one capture, the arrays may contain the images of all views, (views, h, w).
    Raises InputError for arrays of other shapes, colours that are not finite, or depths below 0.
    """

    rgb: Any
    """(h, w, 3) float32 in display space, read-only; uint8 is divided by 255"""
    depth: Any
    """(h, w) float32 metres, along z (along the ray for a fisheye or panorama); infinite, 0 or NaN where
    there is no surface"""
    label: Any = 0
    """(h, w) int32, or one label for all pixels"""

    def __post_init__(self) -> None:
        rgb, depth, label = (
            array_of(f"{name} of external_depth", getattr(self, name), "an array of numbers", "fiu")
            for name in ("rgb", "depth", "label")
        )
        if depth.ndim not in (2, 3) or rgb.shape != (*depth.shape, 3):
            raise InputError(
                f"rgb and depth of external_depth must have shapes (h, w, 3) and (h, w), got {rgb.shape} and "
                f"{depth.shape}"
            )
        white = 255 if rgb.dtype == np.uint8 else 1
        if invalid_count := np.count_nonzero(~np.isfinite(rgb)):
            raise InputError(f"external_depth must have finite colours, got {invalid_count:,} other numbers")
        if (depth < 0).any():
            raise InputError(
                f"external_depth must have depths of at least 0, got {np.nanmin(depth):g}; 0 means no surface"
            )
        if label.dtype.kind not in "iu" or label.shape not in ((), depth.shape):
            raise InputError(
                f"label of external_depth must be integers {depth.shape}, or one for all, got {label.dtype} "
                f"{label.shape}"
            )
        has_surface = np.isfinite(depth) & (depth > 0)
        arrays = {
            "rgb": np.array(rgb, np.float32, order="C") / np.float32(white),
            "depth": np.where(has_surface, depth, np.inf).astype(np.float32),
            "label": np.ascontiguousarray(np.broadcast_to(label, depth.shape), np.int32),
        }
        for name, array in arrays.items():
            array = array.copy() if array is getattr(self, name) else array
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def stacked(self) -> bool:
        """Whether the arrays contain the images of all views of a batch."""
        return len(self.depth.shape) > 2

    @property
    def nbytes(self) -> int:
        """Size of the arrays on a device in bytes."""
        return 20 * math.prod(self.depth.shape)

    def of_views(self, views: int | slice | np.ndarray) -> ExternalDepth:
        """The images of some views of a batch. For an index array, they are copied to the host."""
        images = object.__new__(type(self))  # they are validated already
        for name in ("rgb", "depth", "label"):
            array = getattr(self, name)
            if isinstance(views, np.ndarray) and not isinstance(array, np.ndarray):
                array = array.numpy()
            object.__setattr__(images, name, array[views])
        return images


@dataclass(frozen=True, eq=False)
class DeviceExternalDepth(ExternalDepth):
    """External depth images of a batch on the device of a Warp renderer, not validated: wp.arrays (views, h,
    w) of vec3, float32 (infinite where there is no surface) and int32. They must not change until the
    rendered images are read."""

    def __post_init__(self) -> None:
        pass

    def __reduce__(self):
        return ExternalDepth, tuple(array.numpy() for array in (self.rgb, self.depth, self.label))


Background = tuple[float, float, float] | Gradient | Panorama


def background_of(value: Any) -> Background:
    """Validated background; a gradient between equal colours becomes that colour."""
    if isinstance(value, Gradient) and value.top == value.bottom:
        return value.top
    if isinstance(value, (Gradient, Panorama)):
        return value
    if isinstance(value, np.ndarray) and value.ndim > 1:
        raise InputError(
            f"background must be three numbers, got an array of shape {value.shape}; give an image as "
            "fs.Panorama(array)"
        )
    return three_numbers("background", value)
