"""Conversion of views to the structs of kernels/warp: uniforms, rays, lens, moving groups, background."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import View
from fidsplat.backends.warp.cloud import WarpCloud
from fidsplat.backends.warp.kernel_config import KernelConfig
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.workspace import ArrayPool, Workspace, nbytes
from fidsplat.cameras.lenses import camera_effect
from fidsplat.cameras.raster import RayRaster
from fidsplat.capture.environment import Gradient, Panorama
from fidsplat.util.errors import DeviceError, bytes_words


@cache
def _record() -> Any:
    return np.dtype(kernels("common").View.numpy_dtype())


def uniforms(batch: ViewBatch, config: KernelConfig, splats: int, has_ray_derivatives: bool) -> np.ndarray:
    """The structs `View` (views,). has_ray_derivatives: whether kernels read the derivatives of rays."""
    view = batch.view
    derived = {
        **{"tile_w": config.tile_width, "tile_h": config.tile_height, "splats": splats},
        **{"tiles_x": -(-view.width // config.tile_width), "tiles_y": -(-view.height // config.tile_height)},
        **{"sample_area": 1.0 / view.samples**2, "rotation": batch.rotation[0]},
        **{"translation": batch.translation[0], "eye": batch.eye[0], **batch.camera_parameters},
        # filled below
        **{"per_focal_x": 0.0, "per_focal_y": 0.0, "per_near": 0.0, "ray": 0.0, "max_ray_derivative": 0.0},
    }
    filled: Any = np.zeros(len(batch), _record())
    for name in filled.dtype.names:
        filled[name] = derived[name] if name in derived else getattr(view, name)
    for name in ("focal_x", "focal_y", "near"):
        filled[f"per_{name}"] = 1.0 / filled[name]
    filled["ray"] = view.uniforms_of("ray")
    if not (view.along_ray or view.parallel):  # otherwise depths are distances
        own = (filled["focal_x"], filled["focal_y"], filled["center_x"], filled["center_y"])
        filled["ray"] = np.stack(own, axis=1)
    if has_ray_derivatives and view.raster:
        filled["max_ray_derivative"] = view.raster.max_ray_derivative
    return filled


def rays_of(
    view: View,
    workspace: Workspace,
    inputs: ArrayPool,
    has_lens: bool = True,
    has_ray_derivatives: bool = False,
    has_external_depth: bool = False,
) -> Any:
    """The struct `Rays` of a view.

    inputs: pool for the external depth image. has_lens: include the rays of a lens. has_ray_derivatives:
    include their derivatives. has_external_depth: include the external depth image.
    """
    wp, raster = load(), view.raster if has_lens else None
    kind = kernels("rays").struct_of_rays(
        raster is not None, raster is not None and has_ray_derivatives, has_external_depth
    )
    if raster is None and not has_external_depth:
        return _empty(kind)
    rays = kind()
    if has_external_depth:
        for name, dtype in (("external_depth", wp.float32), ("external_rgb", wp.vec3)):
            setattr(rays, name, inputs.filled(name, view.array(name), dtype))
    if raster is None:
        return rays
    arrays = _arrays(raster, workspace)
    first = raster.top * raster.width
    rays.rays = arrays["rays"][first:]
    if has_ray_derivatives:
        if "ray_derivatives" not in arrays:
            ray_derivatives = (raster.full_raster or raster).ray_derivatives.reshape(-1, 2, 3)
            arrays["ray_derivatives"] = _fresh(
                "ray derivatives", ray_derivatives, kernels("rays").RAY_DERIVATIVES, workspace
            )
        rays.ray_derivatives = arrays["ray_derivatives"][first:]
    return rays


def array_of(batch: ViewBatch, name: str) -> np.ndarray:
    """Array of an effect: one array for all views, or the arrays of the views concatenated."""
    view = batch.view
    if name != "row_rotations" or len(batch) == 1:
        return view.array(name)
    return np.repeat(batch.rotation[0].astype(np.float32), view.height // view.samples, axis=0)


def lens_of(view: View, workspace: Workspace) -> Any:
    """The struct `Lens` of a view; empty without a lens."""
    wp, declared, raster = load(), kernels("lens"), view.raster
    if raster is None:
        return _empty(declared.make_lens(None))
    camera, arrays = camera_effect(raster.lens), _arrays(raster, workspace)
    lens = declared.make_lens(camera)()
    lens.rays = arrays["rays"][raster.top * raster.width :]
    if camera in declared.COEFFICIENTS:
        *k, lens.limit = raster.lens.uniforms
        low_x, low_y, per_x, per_y, side, top = raster.uniforms[-6:]
        lens.k = declared.COEFFICIENTS[camera](*k)
        lens.low, lens.per_unit = wp.vec2d(low_x, low_y), wp.vec2d(per_x, per_y)
        lens.cells, lens.side, lens.top = arrays["cells"], int(side), int(top)
    return lens


def moving_of(cloud: WarpCloud, batch: ViewBatch, inputs: ArrayPool) -> Any:
    """Struct `Moving` of a frame; empty without moving groups. inputs: pool for its arrays."""
    declared, groups = kernels("motion"), batch.view.groups
    kind = declared.make_motion(bool(groups)).Moving
    if not groups:
        return _empty(kind)
    cached = kind()
    labels = np.array([label for label, _ in groups], np.int32)
    poses: Any = np.zeros((len(batch), len(groups)), declared.Pose.numpy_dtype())
    for name in ("rotation", "translation", "eye"):
        poses[name] = np.swapaxes(getattr(batch, name)[1:], 0, 1)
    cached.labels = cloud.arrays["labels"]
    cached.groups = inputs.filled("groups", labels, load().int32)
    cached.poses = inputs.filled("poses", poses.ravel(), declared.Pose)
    return cached


@cache
def _empty(kind: Any) -> Any:
    """Empty struct, which all frames share so that it is packed only once."""
    return kind()


def environment_of(view: View, workspace: Workspace) -> Any:
    wp, behind = load(), view.environment_map
    kind = "gradient" if isinstance(behind, Gradient) else "panorama"
    filled = kernels("background").struct_of_environment(kind)()
    if isinstance(behind, Gradient):
        numbers = view.uniforms_of("gradient")
        filled.top, filled.bottom, filled.up = (wp.vec3(*numbers[k : k + 3]) for k in (0, 3, 6))
    elif isinstance(behind, Panorama):
        filled.image = _panorama(behind, workspace)
    return filled


def memory_bytes(view: View, workspace: Workspace) -> int:
    """Bytes of the arrays of a view's lens, panorama and external depth image."""
    around, raster, external, size = view.environment_map, view.raster, view.external_depth, 0
    if raster is not None:
        size += sum(map(nbytes, workspace.lenses.get(raster.full_raster or raster, {}).values()))
    if isinstance(around, Panorama):
        size += around.image.nbytes
    if external is not None:
        size += external.nbytes
    return size


def _arrays(raster: RayRaster, workspace: Workspace) -> dict[str, Any]:
    """Device arrays of a lens's rays."""
    wp, raster = load(), raster.full_raster or raster
    cached = workspace.lenses.setdefault(raster, {})
    if not cached:
        cached["rays"] = _fresh("rays", raster.rays.reshape(-1, 3), wp.vec3, workspace)
        if raster.lens.kind != "equirectangular":
            cached["cells"] = _fresh(
                "inverse lens lookup table", raster.inverse_lens_lut[0], wp.vec4s, workspace
            )
    return cached


def _fresh(name: str, array: np.ndarray, dtype: Any, workspace: Workspace) -> Any:
    wp = load()
    cached = workspace.pool.allocate(name, len(array), dtype)
    wp.copy(cached, wp.array(array, dtype=dtype, device="cpu"))
    return cached


def _panorama(panorama: Panorama, workspace: Workspace) -> Any:
    wp, cached = load(), workspace.panoramas
    if panorama not in cached:
        image = panorama.image
        try:
            cached[panorama] = wp.array(image, dtype=wp.vec3, device=workspace.device)
        except (RuntimeError, MemoryError) as error:
            raise DeviceError(
                f"the panorama must fit the memory of {workspace.device}, got "
                f"{bytes_words(image.nbytes)}; use a smaller panorama"
            ) from error
    return cached[panorama]
