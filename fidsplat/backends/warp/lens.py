"""What kernels read of a lens (kernels/warp/lens.py), in arrays that are kept as long as its raster is."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.memory import ArrayPool
from fidsplat.cameras.raster import RayRaster

EFFECTS = frozenset(
    {"camera_brown_conrady", "camera_fisheye", "camera_equirectangular", "rays", "ray_map", "polygon"}
)
"""the lenses, and what the catalogue says that they are made of"""


class LensArrays:
    """Rays and maps of the rasters that were drawn last."""

    def __init__(self) -> None:
        self._held: WeakKeyDictionary[RayRaster, tuple[Any, Any]] = WeakKeyDictionary()

    def of(self, view: View, pool: ArrayPool) -> tuple[Any, Any]:
        """The structs `Lens` and `Rays` of a view; empty ones if it has no raster.

        Raises:
            DeviceError: the device has no memory for them.
        """
        import warp as wp

        kernels, raster = runtime.kernels("lens"), view.raster
        if raster is None:
            return kernels.make_lens(None)(), kernels.make_rays(False)()
        camera = f"camera_{raster.lens.kind}"
        lens, rays = kernels.make_lens(camera)(), kernels.make_rays(True)()
        directions, cells = self._arrays(raster.whole or raster, pool)
        lens.rays = rays.rays = directions[raster.top * raster.width :]
        if camera in kernels.COEFFICIENTS:
            *k, lens.limit = raster.lens.uniforms
            low_x, low_y, per_x, per_y, side, top = raster.uniforms[-6:]
            lens.k = kernels.COEFFICIENTS[camera](*k)
            lens.low, lens.per_unit = wp.vec2d(low_x, low_y), wp.vec2d(per_x, per_y)
            lens.cells, lens.side, lens.top = cells, int(side), int(top)
        return lens, rays

    def nbytes(self, view: View) -> int:
        """Bytes that a view's take on the device."""
        if view.raster is None:
            return 0
        arrays = self._held.get(view.raster.whole or view.raster, ())
        return sum(array.size * array.strides[0] for array in arrays if array is not None)

    def _arrays(self, raster: RayRaster, pool: ArrayPool) -> tuple[Any, Any]:
        import warp as wp

        if raster not in self._held:
            rays = _uploaded("rays", raster.rays.reshape(-1, 3), wp.vec3, pool)
            mapped = raster.lens.kind != "equirectangular"
            cells = _uploaded("ray map", raster.map[0], wp.vec4s, pool) if mapped else None
            self._held[raster] = rays, cells
        return self._held[raster]


def _uploaded(name: str, array: np.ndarray, dtype: Any, pool: ArrayPool) -> Any:
    import warp as wp

    held = pool.fresh(name, len(array), dtype)
    wp.copy(held, wp.array(array, dtype=dtype, device="cpu"))
    return held
