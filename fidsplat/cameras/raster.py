"""Rays of a lens on a grid of samples, and the inverse lookup table with which kernels bound splats."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from fidsplat.cameras.lenses import Fisheye, RayLens, RayTable

MAX_CELLS = 512
"""maximum number of cells per axis of the finest grid"""
_CHUNK = 1 << 18
"""samples whose rays are computed at once, which bounds memory"""
_EMPTY_BOX = np.array([32767, -1, 32767, -1], np.int16)


@dataclass(frozen=True, eq=False)
class RayRaster:
    """Sample grid of a lens, independent of the pose. Sizes, focal lengths and centre are in samples."""

    lens: RayLens
    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    full_raster: RayRaster | None = None
    """the raster of all rows, if this one is a band of rows"""
    top: int = 0
    """first row in the full raster"""

    def rows(self, top: int, end: int) -> RayRaster:
        """The raster of rows [top, end), with the `inverse_lens_lut` of the full raster."""
        return replace(self, height=end - top, center_y=self.center_y - top, full_raster=self, top=top)

    @cached_property
    def rays(self) -> np.ndarray:
        """(h, w, 3) float32: direction of each sample's ray, with Z = 1 or of unit length; NaN outside the
        field of view. All devices and the reference renderer use these rounded rays."""
        if self.full_raster is not None:
            return self.full_raster.rays[self.top : self.top + self.height]
        rays = np.empty((self.height, self.width, 3), np.float32)
        step = max(1, _CHUNK // self.width)
        a = (np.arange(self.width) + 0.5 - self.center_x) / self.focal_x
        for top in range(0, self.height, step):
            b = (np.arange(top, min(top + step, self.height)) + 0.5 - self.center_y) / self.focal_y
            image = np.stack(np.broadcast_arrays(a[None, :], b[:, None]), 2).reshape(-1, 2)
            rays[top : top + step] = self.lens.rays(image).reshape(len(b), self.width, 3)
        rays.flags.writeable = False
        return rays

    @cached_property
    def ray_derivatives(self) -> np.ndarray:
        """(h, w, 2, 3) float32: derivatives of the rays with respect to x and y in samples; NaN outside the
        field of view."""
        if self.full_raster is not None:
            return self.full_raster.ray_derivatives[self.top : self.top + self.height]
        derivatives = np.empty((self.height, self.width, 2, 3), np.float32)
        step = max(1, _CHUNK // self.width)
        for top in range(0, self.height, step):
            rays = self.rays[top : top + step].reshape(-1, 3).astype(np.float64)
            jacobian = self.lens.derivative(rays) * np.array([[self.focal_x], [self.focal_y]])
            if not self.lens.along_ray:
                jacobian[:, :, 2] = 0.0  # all rays have Z = 1, so their differences have Z = 0
            x, y = jacobian[:, 0], jacobian[:, 1]
            xx, yy, xy = ((a * b).sum(1)[:, None] for a, b in ((x, x), (y, y), (x, y)))
            with np.errstate(divide="ignore", invalid="ignore"):
                # the pseudo-inverse J^T (J J^T)^-1 of the Jacobian J of the projection
                by_x = (yy * x - xy * y) / (xx * yy - xy * xy)
                by_y = (xx * y - xy * x) / (xx * yy - xy * xy)
            derivatives[top : top + step] = np.stack([by_x, by_y], 1).reshape(-1, self.width, 2, 3)
        derivatives.flags.writeable = False
        return derivatives

    @cached_property
    def max_ray_derivative(self) -> float:
        """Maximum length of a ray's derivative over all samples and image directions, rounded up."""
        if self.full_raster is not None:
            return self.full_raster.max_ray_derivative
        by_x, by_y = np.moveaxis(self.ray_derivatives, 2, 0)
        xx, yy, xy = ((a * b).sum(2) for a, b in ((by_x, by_x), (by_y, by_y), (by_x, by_y)))
        squared = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
        return float(np.sqrt(np.nanmax(squared))) * 1.00001

    def lut_coordinates(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (x, y) of rays in `inverse_lens_lut`: in the undistorted pinhole image, in samples; for
        a fisheye or a ray table, of the stereographic projection (X, Y) / (|ray| + Z)."""
        x, y, z = np.moveaxis(rays.astype(np.float64), -1, 0)
        if isinstance(self.lens, Fisheye | RayTable):
            denominator = z + np.sqrt(x * x + y * y + z * z)
            return x / denominator, y / denominator
        return self.focal_x * x / z + self.center_x, self.focal_y * y / z + self.center_y

    @cached_property
    def inverse_lens_lut(self) -> tuple[np.ndarray, np.ndarray]:
        """Inverse lookup table of the lens, from ray directions to samples: a pyramid of grids over the
        `lut_coordinates`, from cells x cells to 1 x 1, with the bounds of each cell's samples.

        Returns boxes (cells^2 + (cells / 2)^2 + ... + 1, 4) int16, the first and last column and the first
        and last row of the samples whose rays are in a cell (last < first if there are none); and (low_x,
        low_y, cells per unit along x, along y, cells) float64.
        """
        if self.full_raster is not None:
            return self.full_raster.inverse_lens_lut
        rows, columns = np.nonzero(np.isfinite(self.rays[..., 0]))
        cells = 1
        while 2 * cells <= min(MAX_CELLS, max(self.width, self.height) // 2):
            cells *= 2
        x, y = self.lut_coordinates(self.rays[rows, columns])
        low = np.array([x.min(), y.min()])
        # the samples at the upper edge belong to the last cell
        scale = cells * (1 - 1e-9) / np.maximum(np.array([x.max(), y.max()]) - low, 1e-12)
        cell = np.minimum((y - low[1]) * scale[1], cells - 1).astype(np.int64) * cells
        cell += np.minimum((x - low[0]) * scale[0], cells - 1).astype(np.int64)
        boxes = np.tile(_EMPTY_BOX, (cells * cells, 1))
        for k, (ufunc, values) in enumerate(
            [(np.minimum, columns), (np.maximum, columns), (np.minimum, rows), (np.maximum, rows)]
        ):
            ufunc.at(boxes[:, k], cell, values.astype(np.int16))
        levels, size = [boxes], cells
        while size > 1:
            fine = levels[-1].reshape(size // 2, 2, size // 2, 2, 4)
            coarse = np.empty((size // 2, size // 2, 4), np.int16)
            coarse[..., ::2] = fine[..., ::2].min((1, 3))
            coarse[..., 1::2] = fine[..., 1::2].max((1, 3))
            size //= 2
            levels.append(coarse.reshape(-1, 4))
        return np.concatenate(levels), np.array([*low, *scale, cells])

    @property
    def uniforms(self) -> tuple[float, ...]:
        """Kernel uniforms: parameters of the lens, grid of `inverse_lens_lut`, first row."""
        if self.lens.kind == "equirectangular":
            return self.lens.uniforms
        low_x, low_y, *rest = map(float, self.inverse_lens_lut[1])
        if not isinstance(self.lens, Fisheye | RayTable):
            low_y -= self.top  # a band counts rows from its own top, the pyramid from the full raster's
        return (*self.lens.uniforms, low_x, low_y, *rest, float(self.top))


@lru_cache(maxsize=4)
def raster_of(
    lens: RayLens, width: int, height: int, focal_x: float, focal_y: float, center_x: float, center_y: float
) -> RayRaster:
    """Cached raster, shared by images from many poses."""
    return RayRaster(lens, width, height, focal_x, focal_y, center_x, center_y)
