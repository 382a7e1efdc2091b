"""Device buffers of a lens's rays, kept as long as its raster is."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from fidsplat.cameras.raster import RayRaster

if TYPE_CHECKING:
    from fidsplat.backends.opencl.backend import OpenCLBackend


class RayBuffers:
    """The buffers `rays`, `ray_map` and so on (kernels/opencl/slot) of the rasters that were drawn last."""

    def __init__(self, backend: OpenCLBackend) -> None:
        self._backend = backend
        self._held: WeakKeyDictionary[RayRaster, dict[tuple[int, int], dict[str, cl.Buffer]]] = (
            WeakKeyDictionary()
        )

    def of(self, raster: RayRaster, rows: int, columns: int, slopes: bool = False) -> dict[str, cl.Buffer]:
        """Buffers by name, for a sample grid that is padded to rows x columns. slopes: those of boxes too."""
        sizes = self._held.setdefault(raster, {})
        if (rows, columns) not in sizes:
            sizes[rows, columns] = {"rays": self._planes("rays", raster.rays, rows, columns)}
            if raster.lens.kind != "equirectangular":
                sizes[rows, columns]["ray_map"] = self._map(raster.whole or raster)
        held = sizes[rows, columns]
        if slopes and "ray_slopes" not in held:
            flat = raster.slopes.reshape(raster.height, raster.width, 6)
            held["ray_slopes"] = self._planes("ray_slopes", flat, rows, columns)
            held["ray_step"] = self._put("ray_step", np.float32([raster.step]))
        return held

    def _planes(self, name: str, array: np.ndarray, rows: int, columns: int) -> cl.Buffer:
        planes = np.full((array.shape[2], rows, columns), np.nan, np.float32)
        planes[:, : array.shape[0], : array.shape[1]] = np.moveaxis(array, 2, 0)
        return self._put(name, planes)

    @staticmethod
    def bytes_of(rasters: Collection[RayRaster], tile_height: int, columns: int, slopes: bool) -> int:
        """What the buffers of the rasters of one picture take, for grids that are padded to whole tiles."""
        rows = sum(-(-raster.height // tile_height) * tile_height for raster in rasters)
        one = next(iter(rasters))
        each = 36 if slopes else 12
        return each * rows * columns + (one.map[0].nbytes if one.lens.kind != "equirectangular" else 0)

    def _map(self, raster: RayRaster) -> cl.Buffer:
        maps = self._held.setdefault(raster, {}).setdefault((0, 0), {})
        if "ray_map" not in maps:
            maps["ray_map"] = self._put("ray_map", raster.map[0])
        return maps["ray_map"]

    def _put(self, name: str, array: np.ndarray) -> cl.Buffer:
        buffer = self._backend.pool.fresh(name, array.nbytes)
        cl.enqueue_copy(self._backend.queue, buffer, array)
        return buffer
