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
    """The buffers `rays` and `ray_map` (kernels/opencl/slot) of the rasters that were drawn last."""

    def __init__(self, backend: OpenCLBackend) -> None:
        self._backend = backend
        self._held: WeakKeyDictionary[RayRaster, dict[tuple[int, int], dict[str, cl.Buffer]]] = (
            WeakKeyDictionary()
        )

    def of(self, raster: RayRaster, rows: int, columns: int) -> dict[str, cl.Buffer]:
        """Buffers by name, for a sample grid that is padded to rows x columns."""
        sizes = self._held.setdefault(raster, {})
        if (rows, columns) not in sizes:
            planes = np.full((3, rows, columns), np.nan, np.float32)
            planes[:, : raster.height, : raster.width] = np.moveaxis(raster.rays, 2, 0)
            sizes[rows, columns] = {"rays": self._put("rays", planes)}
            if raster.lens.kind != "equirectangular":
                sizes[rows, columns]["ray_map"] = self._map(raster.whole or raster)
        return sizes[rows, columns]

    @staticmethod
    def bytes_of(rasters: Collection[RayRaster], tile_height: int, columns: int) -> int:
        """What the buffers of the rasters of one picture take, for grids that are padded to whole tiles."""
        rows = sum(-(-raster.height // tile_height) * tile_height for raster in rasters)
        one = next(iter(rasters))
        return 12 * rows * columns + (one.map[0].nbytes if one.lens.kind != "equirectangular" else 0)

    def _map(self, raster: RayRaster) -> cl.Buffer:
        maps = self._held.setdefault(raster, {}).setdefault((0, 0), {})
        if "ray_map" not in maps:
            maps["ray_map"] = self._put("ray_map", raster.map[0])
        return maps["ray_map"]

    def _put(self, name: str, array: np.ndarray) -> cl.Buffer:
        buffer = self._backend.pool.fresh(name, array.nbytes)
        cl.enqueue_copy(self._backend.queue, buffer, array)
        return buffer
