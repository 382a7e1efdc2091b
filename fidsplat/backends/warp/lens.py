"""What kernels read of a lens (kernels/warp/lens.py), in arrays that are kept as long as its raster is."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from fidsplat.backends.view import View
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.memory import ArrayPool
from fidsplat.cameras.raster import RayRaster

EFFECTS = frozenset(
    {"camera_brown_conrady", "camera_fisheye", "camera_equirectangular", "rays", "ray_map", "polygon"}
    | {"rays_length", "rays_sample_length", "rays_box"}
)
"""the lenses, and what the catalogue says that they are made of"""


class LensArrays:
    """Rays and maps of the rasters that were drawn last."""

    def __init__(self) -> None:
        self._held: WeakKeyDictionary[RayRaster, dict[str, Any]] = WeakKeyDictionary()

    def rays(self, view: View, pool: ArrayPool, given: bool = True, sloped: bool = False) -> Any:
        """The struct `Rays` of a view, with derivatives if `sloped`; an empty one if it has no raster, or
        none is `given`.

        Raises:
            DeviceError: the device has no memory for them.
        """
        kernels, raster = runtime.kernels("lens"), view.raster
        if raster is None or not given:
            return kernels.make_rays(False)()
        rays, arrays = kernels.make_rays(True, sloped)(), self._arrays(raster, pool)
        first = raster.top * raster.width
        rays.rays = arrays["rays"][first:]
        if sloped:
            if "slopes" not in arrays:
                slopes = (raster.whole or raster).slopes.reshape(-1, 2, 3)
                arrays["slopes"] = _uploaded("ray slopes", slopes, kernels.SLOPES, pool)
            rays.slopes = arrays["slopes"][first:]
        return rays

    def lens(self, view: View, pool: ArrayPool) -> Any:
        """The struct `Lens` of a view; an empty one if it has no raster.

        Raises:
            DeviceError: the device has no memory for its arrays.
        """
        import warp as wp

        kernels, raster = runtime.kernels("lens"), view.raster
        if raster is None:
            return kernels.make_lens(None)()
        camera, arrays = f"camera_{raster.lens.kind}", self._arrays(raster, pool)
        lens = kernels.make_lens(camera)()
        lens.rays = arrays["rays"][raster.top * raster.width :]
        if camera in kernels.COEFFICIENTS:
            *k, lens.limit = raster.lens.uniforms
            low_x, low_y, per_x, per_y, side, top = raster.uniforms[-6:]
            lens.k = kernels.COEFFICIENTS[camera](*k)
            lens.low, lens.per_unit = wp.vec2d(low_x, low_y), wp.vec2d(per_x, per_y)
            lens.cells, lens.side, lens.top = arrays["cells"], int(side), int(top)
        return lens

    def nbytes(self, view: View) -> int:
        """Bytes that a view's take on the device."""
        if view.raster is None:
            return 0
        arrays = self._held.get(view.raster.whole or view.raster, {})
        return sum(array.size * array.strides[0] for array in arrays.values())

    def _arrays(self, raster: RayRaster, pool: ArrayPool) -> dict[str, Any]:
        """Of the whole raster."""
        import warp as wp

        raster = raster.whole or raster
        held = self._held.setdefault(raster, {})
        if not held:
            held["rays"] = _uploaded("rays", raster.rays.reshape(-1, 3), wp.vec3, pool)
            if raster.lens.kind != "equirectangular":
                held["cells"] = _uploaded("ray map", raster.map[0], wp.vec4s, pool)
        return held


def _uploaded(name: str, array: np.ndarray, dtype: Any, pool: ArrayPool) -> Any:
    import warp as wp

    held = pool.fresh(name, len(array), dtype)
    wp.copy(held, wp.array(array, dtype=dtype, device="cpu"))
    return held
