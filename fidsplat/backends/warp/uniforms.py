"""The structs of kernels/warp that a picture's view fills: its numbers, its lens, what moves, and what lies
behind the splats. Arrays of lenses and panoramas are kept as long as these are."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import View
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.shapes import WarpShape
from fidsplat.backends.warp.workspace import ArrayPool, Workspace, nbytes
from fidsplat.cameras.raster import RayRaster
from fidsplat.capture.environment import Gradient, Panorama
from fidsplat.util.errors import DeviceError, bytes_words

_DERIVED: dict[str, Callable[[View, WarpShape], Any]] = {
    "tile_w": lambda view, shape: shape.tile_width,
    "tile_h": lambda view, shape: shape.tile_height,
    "tiles_x": lambda view, shape: -(-view.width // shape.tile_width),
    "tiles_y": lambda view, shape: -(-view.height // shape.tile_height),
    "per_pixel": lambda view, shape: 1.0 / view.samples**2,
}
"""fields that a view does not have by their names"""
_LATER = frozenset({"per_focal_x", "per_focal_y", "per_near", "ray", "ray_step", "splats"})
"""those that follow from others, or from what a view does not know"""


@cache
def _record() -> Any:
    return np.dtype(kernels("common").View.numpy_dtype())


def uniforms(stack: ViewBatch, shape: WarpShape, splats: int, sloped: bool) -> np.ndarray:
    """(views,) of the struct `View`, of pictures in tiles of this shape. splats: of the cloud. sloped: its
    kernels read rays' derivatives."""
    view = stack.view
    filled: Any = np.zeros(len(stack), _record())
    for name in filled.dtype.names:
        if name not in _LATER:
            derive = _DERIVED.get(name)
            filled[name] = derive(view, shape) if derive else getattr(view, name)
    for name in ("rotation", "translation", "eye"):
        filled[name] = getattr(stack, name)[0]
    for name, numbers in stack.numbers.items():
        filled[name] = numbers
    for name in ("focal_x", "focal_y", "near"):
        filled[f"per_{name}"] = 1.0 / filled[name]
    if not (view.along_ray or view.parallel):  # else depths are distances already, and the ray is 0
        own = (filled["per_focal_x"], filled["per_focal_y"], filled["center_x"], filled["center_y"])
        filled["ray"] = np.stack(own, axis=1)
    filled["splats"] = splats
    if sloped and view.raster:
        filled["ray_step"] = view.raster.step  # of which it takes long to ask
    return filled


def rays_of(
    view: View,
    workspace: Workspace,
    inputs: ArrayPool,
    bent: bool = True,
    sloped: bool = False,
    opaque: bool = False,
) -> Any:
    """The struct `Rays` of a view, with derivatives if `sloped`, with its layer if `opaque`; without rays if
    it has no raster, or unless `bent`. inputs: of the layer.

    Raises:
        DeviceError: the device has no memory for them.
    """
    wp, raster = load(), view.raster if bent else None
    kind = kernels("rays").struct_of_rays(raster is not None, raster is not None and sloped, opaque)
    if raster is None and not opaque:
        return _empty(kind)
    rays = kind()
    if opaque:
        for name, dtype in (("external_depth", wp.float32), ("external_rgb", wp.vec3)):
            setattr(rays, name, inputs.filled(name, view.array(name), dtype))
    if raster is None:
        return rays
    arrays = _arrays(raster, workspace)
    first = raster.top * raster.width
    rays.rays = arrays["rays"][first:]
    if sloped:
        if "slopes" not in arrays:
            slopes = (raster.whole or raster).slopes.reshape(-1, 2, 3)
            arrays["slopes"] = _fresh("ray slopes", slopes, kernels("rays").SLOPES, workspace)
        rays.slopes = arrays["slopes"][first:]
    return rays


def array_of(stack: ViewBatch, name: str) -> np.ndarray:
    """An array of an effect, which all views have in common, or the rows of one view after the other's."""
    view = stack.view
    if name != "row_rotations" or len(stack) == 1:
        return view.array(name)
    return np.repeat(stack.rotation[0].astype(np.float32), view.height // view.samples, axis=0)


def lens_of(view: View, workspace: Workspace) -> Any:
    """The struct `Lens` of a view; an empty one if it has no raster.

    Raises:
        DeviceError: the device has no memory for its arrays.
    """
    wp, declared, raster = load(), kernels("lens"), view.raster
    if raster is None:
        return _empty(declared.make_lens(None))
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


def moving_of(resident: Resident, stack: ViewBatch, inputs: ArrayPool) -> Any:
    """The struct `Moving` of a picture; an empty one if nothing moves. inputs: of its arrays."""
    declared, groups = kernels("motion"), stack.view.groups
    kind = declared.make_motion(bool(groups)).Moving
    if not groups:
        return _empty(kind)
    held = kind()
    labels = np.array([label for label, _ in groups], np.int32)
    poses: Any = np.zeros((len(stack), len(groups)), declared.Pose.numpy_dtype())
    for name in ("rotation", "translation", "eye"):
        poses[name] = np.swapaxes(getattr(stack, name)[1:], 0, 1)
    held.labels = resident.arrays["labels"]
    held.groups = inputs.filled("groups", labels, load().int32)
    held.poses = inputs.filled("poses", poses.ravel(), declared.Pose)
    return held


@cache
def _empty(kind: Any) -> Any:
    """A struct without arrays: the same from picture to picture, so that no launch packs it again."""
    return kind()


def surroundings_of(view: View, workspace: Workspace) -> Any:
    """The struct `Surroundings` of a view whose background is not of one colour. A panorama stays on the
    device as long as it lives.

    Raises:
        DeviceError: there is no room for the panorama.
    """
    wp, behind = load(), view.surroundings
    kind = "gradient" if isinstance(behind, Gradient) else "panorama"
    filled = kernels("background").struct_of_surroundings(kind)()
    if isinstance(behind, Gradient):
        numbers = view.uniform("gradient")
        filled.top, filled.bottom, filled.up = (wp.vec3(*numbers[k : k + 3]) for k in (0, 3, 6))
    elif isinstance(behind, Panorama):
        filled.image = _panorama(behind, workspace)
    return filled


def memory_bytes(view: View, workspace: Workspace) -> int:
    """Bytes that the arrays of a view's lens, panorama and external depth image take on the device."""
    around, raster, external = view.surroundings, view.raster, view.external_depth
    held = {} if raster is None else workspace.lenses.get(raster.whole or raster, {})
    taken = [around.image] if isinstance(around, Panorama) else []
    taken += [] if external is None else [external.rgb, external.depth, external.label]
    return sum(map(nbytes, held.values())) + sum(array.nbytes for array in taken)


def _arrays(raster: RayRaster, workspace: Workspace) -> dict[str, Any]:
    """Of the whole raster."""
    wp, raster = load(), raster.whole or raster
    held = workspace.lenses.setdefault(raster, {})
    if not held:
        held["rays"] = _fresh("rays", raster.rays.reshape(-1, 3), wp.vec3, workspace)
        if raster.lens.kind != "equirectangular":
            held["cells"] = _fresh("ray map", raster.map[0], wp.vec4s, workspace)
    return held


def _fresh(name: str, array: np.ndarray, dtype: Any, workspace: Workspace) -> Any:
    wp = load()
    held = workspace.pool.fresh(name, len(array), dtype)
    wp.copy(held, wp.array(array, dtype=dtype, device="cpu"))
    return held


def _panorama(panorama: Panorama, workspace: Workspace) -> Any:
    wp, held = load(), workspace.panoramas
    if panorama not in held:
        image = panorama.image
        try:
            held[panorama] = wp.array(image, dtype=wp.vec3, device=workspace.device)
        except (RuntimeError, MemoryError) as error:
            raise DeviceError(
                f"the panorama needs {bytes_words(image.nbytes)}, which {workspace.device} has not; use a "
                "smaller one"
            ) from error
    return held[panorama]
