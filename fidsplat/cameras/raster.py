"""Ray tables of a lens on a sample grid, and bounds of the samples per cell of directions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from fidsplat.cameras.lenses import Fisheye, RayLens, RayTable

CELLS = 512
"""maximum number of cells per axis of the finest grid"""
_ROWS = 1 << 18  # samples whose rays are computed at once, which bounds memory
_EMPTY = np.array([32767, -1, 32767, -1], np.int16)


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
    whole: RayRaster | None = None
    """the complete raster, if this one is a band of its rows"""
    top: int = 0
    """first row in the complete raster"""

    def cropped(self, top: int, end: int) -> RayRaster:
        """Rows [top, end), which share the map of the complete raster."""
        return replace(self, height=end - top, center_y=self.center_y - top, whole=self, top=top)

    @cached_property
    def rays(self) -> np.ndarray:
        """(h, w, 3) float32: direction of each sample's ray, with Z = 1 or of unit length; NaN outside the
        field of view. All devices and the reference renderer use these rounded rays."""
        if self.whole is not None:
            return self.whole.rays[self.top : self.top + self.height]
        rays = np.empty((self.height, self.width, 3), np.float32)
        step = max(1, _ROWS // self.width)
        a = (np.arange(self.width) + 0.5 - self.center_x) / self.focal_x
        for top in range(0, self.height, step):
            b = (np.arange(top, min(top + step, self.height)) + 0.5 - self.center_y) / self.focal_y
            image = np.stack(np.broadcast_arrays(a[None, :], b[:, None]), 2).reshape(-1, 2)
            rays[top : top + step] = self.lens.rays(image).reshape(len(b), self.width, 3)
        rays.flags.writeable = False
        return rays

    @cached_property
    def slopes(self) -> np.ndarray:
        """(h, w, 2, 3) float32: derivatives of the rays with respect to x and y in samples; NaN outside the
        field of view."""
        if self.whole is not None:
            return self.whole.slopes[self.top : self.top + self.height]
        slopes = np.empty((self.height, self.width, 2, 3), np.float32)
        step = max(1, _ROWS // self.width)
        for top in range(0, self.height, step):
            rays = self.rays[top : top + step].reshape(-1, 3).astype(np.float64)
            by_ray = self.lens.derivative(rays) * np.array([[self.focal_x], [self.focal_y]])
            if not self.lens.along_ray:
                by_ray[:, :, 2] = 0.0  # all rays have Z = 1, so their differences have Z = 0
            # the pseudo-inverse J^T (J J^T)^-1 of the Jacobian J of the projection
            xx, yy, xy = ((by_ray[:, i] * by_ray[:, j]).sum(1)[:, None] for i, j in ((0, 0), (1, 1), (0, 1)))
            with np.errstate(divide="ignore", invalid="ignore"):
                along_x = (yy * by_ray[:, 0] - xy * by_ray[:, 1]) / (xx * yy - xy * xy)
                along_y = (xx * by_ray[:, 1] - xy * by_ray[:, 0]) / (xx * yy - xy * xy)
            slopes[top : top + step] = np.stack([along_x, along_y], 1).reshape(-1, self.width, 2, 3)
        slopes.flags.writeable = False
        return slopes

    @cached_property
    def step(self) -> float:
        """Maximum length of a ray's derivative over all samples and image directions, rounded up."""
        if self.whole is not None:
            return self.whole.step
        along_x, along_y = np.moveaxis(self.slopes, 2, 0)
        xx, yy, xy = ((a * b).sum(2) for a, b in ((along_x, along_x), (along_y, along_y), (along_x, along_y)))
        squared = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
        return float(np.sqrt(np.nanmax(squared))) * 1.00001

    def chart(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates in which kernels bound splats: the undistorted pinhole image in samples, or, for a
        fisheye or a ray table, the stereographic projection (X, Y) / (|ray| + Z)."""
        x, y, z = np.moveaxis(rays.astype(np.float64), -1, 0)
        if isinstance(self.lens, Fisheye | RayTable):
            below = z + np.sqrt(x * x + y * y + z * z)
            return x / below, y / below
        return self.focal_x * x / z + self.center_x, self.focal_y * y / z + self.center_y

    @cached_property
    def map(self) -> tuple[np.ndarray, np.ndarray]:
        """Pyramid of sample bounds over the chart, from grids of cells x cells to 1 x 1, for culling.

        Returns boxes (cells^2 + (cells / 2)^2 + ... + 1, 4) int16, the first and last column and the first
        and last row of the samples whose rays are in a cell (last < first if there are none); and (low_x,
        low_y, cells per unit along x, along y, cells) float64.
        """
        if self.whole is not None:
            return self.whole.map
        rows, columns = np.nonzero(np.isfinite(self.rays[..., 0]))
        cells = 1
        while 2 * cells <= min(CELLS, max(self.width, self.height) // 2):
            cells *= 2
        x, y = self.chart(self.rays[rows, columns])
        low = np.array([x.min(), y.min()])
        # the samples at the upper edge belong to the last cell
        scale = cells * (1 - 1e-9) / np.maximum(np.array([x.max(), y.max()]) - low, 1e-12)
        cell = np.minimum((y - low[1]) * scale[1], cells - 1).astype(np.int64) * cells
        cell += np.minimum((x - low[0]) * scale[0], cells - 1).astype(np.int64)
        boxes = np.tile(_EMPTY, (cells * cells, 1))
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
        """Kernel uniforms: parameters of the lens, grid of the pyramid of bounds (`map`), first row."""
        if self.lens.kind == "equirectangular":
            return self.lens.uniforms
        low_x, low_y, *rest = map(float, self.map[1])
        if not isinstance(self.lens, Fisheye | RayTable):
            low_y -= self.top  # a band counts rows from its own top, the map from the complete raster's
        return (*self.lens.uniforms, low_x, low_y, *rest, float(self.top))


@lru_cache(maxsize=4)
def raster_of(
    lens: RayLens, width: int, height: int, focal_x: float, focal_y: float, center_x: float, center_y: float
) -> RayRaster:
    """Cached raster, shared by images from many poses."""
    return RayRaster(lens, width, height, focal_x, focal_y, center_x, center_y)
