"""What kernels read of a lens (kernels/warp/lens.py, rays.py), in arrays that are kept as long as its raster
is."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.backends.view import View
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.workspace import ArrayPool, Workspace, nbytes
from fidsplat.cameras.raster import RayRaster


def rays_of(view: View, workspace: Workspace, bent: bool = True, sloped: bool = False) -> Any:
    """The struct `Rays` of a view, with derivatives if `sloped`; an empty one if it has no raster, or unless
    `bent`.

    Raises:
        DeviceError: the device has no memory for them.
    """
    struct_of_rays, raster = kernels("rays").struct_of_rays, view.raster
    if raster is None or not bent:
        return struct_of_rays(False)()
    rays, arrays = struct_of_rays(True, sloped)(), _arrays(raster, workspace)
    first = raster.top * raster.width
    rays.rays = arrays["rays"][first:]
    if sloped:
        if "slopes" not in arrays:
            slopes = (raster.whole or raster).slopes.reshape(-1, 2, 3)
            arrays["slopes"] = _uploaded("ray slopes", slopes, kernels("rays").SLOPES, workspace.pool)
        rays.slopes = arrays["slopes"][first:]
    return rays


def lens_of(view: View, workspace: Workspace) -> Any:
    """The struct `Lens` of a view; an empty one if it has no raster.

    Raises:
        DeviceError: the device has no memory for its arrays.
    """
    wp, declared, raster = load(), kernels("lens"), view.raster
    if raster is None:
        return declared.make_lens(None)()
    camera, arrays = f"camera_{raster.lens.kind}", _arrays(raster, workspace)
    lens = declared.make_lens(camera)()
    lens.rays = arrays["rays"][raster.top * raster.width :]
    if camera in declared.COEFFICIENTS:
        *k, lens.limit = raster.lens.uniforms
        low_x, low_y, per_x, per_y, side, top = raster.uniforms[-6:]
        lens.k = declared.COEFFICIENTS[camera](*k)
        lens.low, lens.per_unit = wp.vec2d(low_x, low_y), wp.vec2d(per_x, per_y)
        lens.cells, lens.side, lens.top = arrays["cells"], int(side), int(top)
    return lens


def memory_bytes(view: View, workspace: Workspace) -> int:
    """Bytes that a view's arrays take on the device."""
    if view.raster is None:
        return 0
    return sum(map(nbytes, workspace.lenses.get(view.raster.whole or view.raster, {}).values()))


def _arrays(raster: RayRaster, workspace: Workspace) -> dict[str, Any]:
    """Of the whole raster."""
    wp, raster = load(), raster.whole or raster
    held = workspace.lenses.setdefault(raster, {})
    if not held:
        held["rays"] = _uploaded("rays", raster.rays.reshape(-1, 3), wp.vec3, workspace.pool)
        if raster.lens.kind != "equirectangular":
            held["cells"] = _uploaded("ray map", raster.map[0], wp.vec4s, workspace.pool)
    return held


def _uploaded(name: str, array: np.ndarray, dtype: Any, pool: ArrayPool) -> Any:
    wp = load()
    held = pool.fresh(name, len(array), dtype)
    wp.copy(held, wp.array(array, dtype=dtype, device="cpu"))
    return held
