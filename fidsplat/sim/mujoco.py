"""Rigs with the cameras and bodies of a MuJoCo model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.cameras import Camera, Orthographic
from fidsplat.capture.environment import ExternalDepth
from fidsplat.render.device_external_depth import MESH_LABEL, MESH_OFFSET, device_external_depth
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.sim.poses import OPENGL
from fidsplat.sim.rig import RigCamera, SimulatorRig
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrices_to_quaternions, quaternion_multiply
from fidsplat.util.arguments import instance, whole_number
from fidsplat.util.errors import InputError, required_package, unknown

with required_package("MuJoCo", "sim"):
    import mujoco as _mujoco  # type: ignore[import-not-found]

mujoco: Any = _mujoco  # type checkers do not know its names

_OUTPUTS = {
    "mjCAMOUT_RGB": "rgb",
    "mjCAMOUT_DEPTH": "depth",
    "mjCAMOUT_DIST": "distance",
    "mjCAMOUT_NORMAL": "normal",
    "mjCAMOUT_SEG": "label",
}
"""output name of each MuJoCo camera output"""


class MujocoRig(SimulatorRig):
    """A rig with the cameras of a MuJoCo model and splats attached to its bodies.

    Resolution, fovy, focal length, principal point and outputs are those of the model. The near plane is at
    0.01 m and there is no far plane, since MuJoCo scales both with the model.

    Args:
        model: mujoco.MjModel.
        scene: splats and markers; splats with a label in `bodies` are in the frame of their body.
        bodies: {label: name of the body in the model}.
        cameras: names of the requested cameras; default all cameras that have a name.
        renderer, rest, outputs: as in `Rig`; by default a camera has the outputs of its `output` attribute.

    The state that `render` reads is an MjData, a list of MjData, one for each environment, or mujoco_warp's
    Data; after `mj_forward` or `mj_step`, which compute the poses of bodies and cameras. Its `meshes` may be
    geom groups, by default 0, 1 and 2, rendered by MuJoCo (with OpenGL, for pinhole cameras) or mujoco_warp.
    Geom i has the label `MESH_LABEL` - i.

    Raises:
        InputError: as `Rig`; a body or camera that the model does not have, a camera without a name.
    """

    def __init__(
        self,
        model: Any,
        scene: Scene | SplatCloud,
        bodies: Mapping[int, str] | None = None,
        cameras: Iterable[str] | None = None,
        *,
        renderer: Renderer | None = None,
        rest: Mapping[str, Any] | None = None,
        outputs: Iterable[str] | None = None,
    ) -> None:
        instance("model", model, mujoco.MjModel, "a mujoco.MjModel")
        if isinstance(cameras, str):
            raise InputError(f"cameras must be a list of names, got {cameras!r}; use [{cameras!r}]")
        names_of_model = [model.camera(i).name for i in range(model.ncam)]
        requested = [name for name in names_of_model if name] if cameras is None else list(cameras)
        for name in requested:
            if name not in names_of_model or not name:
                raise InputError(unknown("camera", name, filter(None, names_of_model)))
        cameras_of_rig = [(name, camera_of(model, name, default=outputs is None)) for name in requested]
        super().__init__(scene, bodies, cameras_of_rig, renderer=renderer, rest=rest, outputs=outputs)
        names = [model.body(i).name for i in range(model.nbody)]
        for name in self.bodies:
            if name not in names:
                raise InputError(unknown("body", name, filter(None, names)))
        self._counts = model.nbody, model.ncam
        self._model, self._renderers = model, dict[tuple[int, int], Any]()
        self._contexts: tuple[Any, ...] = (None,)
        self._body_ids = [names.index(name) for name in self.bodies]
        self._camera_ids = [names_of_model.index(name) for name in self.cameras]

    def poses(self, data: Any) -> tuple[np.ndarray, np.ndarray]:
        """Poses of bodies (env, body, 7) and of cameras (env, camera, 7), OpenCV axes. data: as in
        `render`."""
        environments = data if isinstance(data, list | tuple) else [data]
        if not environments:
            raise InputError("data must have at least one MjData, got an empty list")
        parts = [_arrays_of(environment, *self._counts) for environment in environments]
        position, rotation, at, axes = (np.concatenate([part[k] for part in parts]) for k in range(4))
        bodies = np.concatenate([position, rotation], -1)[:, self._body_ids]
        camera_rotation = quaternion_multiply(
            matrices_to_quaternions(axes), np.broadcast_to(OPENGL[3:], (*axes.shape[:2], 4))
        )
        cameras = np.concatenate([at, camera_rotation], -1)[:, self._camera_ids]
        return bodies, cameras

    def _geometry(self, data: Any, poses: Mapping[str, np.ndarray], meshes: Any) -> Mapping[str, Any]:
        groups = [0, 1, 2] if meshes is True else meshes if isinstance(meshes, Iterable) else [meshes]
        groups = [whole_number("a geom group of meshes", group, 0, mujoco.mjNGROUP - 1) for group in groups]
        if hasattr(data, "nworld"):
            return self._world_meshes(data, groups)
        return self._meshes(data if isinstance(data, list | tuple) else [data], groups)

    def _world_meshes(self, data: Any, groups: list[int]) -> dict[str, ExternalDepth]:
        """Images of the model's geoms for each camera and all worlds, by mujoco_warp's ray caster."""
        import mujoco_warp as mjw  # type: ignore[import-not-found]
        import warp as wp  # type: ignore[import-not-found]

        for name, number in zip(self.cameras, self._camera_ids, strict=True):
            width, height = self._model.cam_resolution[number]
            wide, high = self._model.cam_sensorsize[number]
            if high and abs(wide * height - high * width) > 1e-4 * high * width:
                raise InputError(
                    f"the sensorsize of a camera with meshes by mujoco_warp, which crops sensors, must have "
                    f"the aspect ratio of its resolution {width} x {height}, got {wide:g} x {high:g} for "
                    f"{name!r}"
                )
        if not (np.isin(self._model.geom_group, groups).any() or self._model.nflex):
            return {}  # mujoco_warp 4.0 crashes without geoms
        kind = data.nworld, tuple(groups)
        with wp.ScopedDevice(data.qpos.device):
            if self._contexts[0] != kind:
                sizes = [(camera.camera.width, camera.camera.height) for camera in self.cameras.values()]
                context = mjw.create_render_context(
                    self._model, data.nworld, sizes, True, True, True,
                    enabled_geom_groups=groups, cam_active=self._camera_ids,
                )  # fmt: skip
                self._contexts = kind, mjw.put_model(self._model), context
            _, model, context = self._contexts
            mjw.refit_bvh(model, data, context)
            mjw.render(model, data, context)
            pairs = context.seg_data  # (id, type of object)
            ids = wp.array(
                ptr=pairs.ptr, dtype=wp.int32, shape=pairs.shape, strides=pairs.strides, device=pairs.device
            )
            images, first = {}, 0
            for name, camera in self.cameras.items():
                size = camera.camera.height, camera.camera.width
                pixels = slice(first, first := first + size[0] * size[1])
                arrays = context.rgb_data[:, pixels], context.depth_data[:, pixels], ids[:, pixels]
                images[name] = device_external_depth(self.renderer, *arrays, size, red_bit=16)
        return images

    def _meshes(self, data: Sequence[Any], groups: list[int]) -> dict[str, list[ExternalDepth]]:
        """Images of the model's geoms for each camera and environment, by MuJoCo."""
        for state in data:
            instance("data with meshes", state, mujoco.MjData, "a mujoco.MjData")
        self._pinholes()
        option = mujoco.MjvOption()
        option.geomgroup[:] = 0
        option.geomgroup[groups] = 1
        images: dict[str, list[ExternalDepth]] = {}
        for (name, camera), number in zip(self.cameras.items(), self._camera_ids, strict=True):
            renderer = self._mesh_renderer(camera.camera.width, camera.camera.height)
            images[name] = [_mesh_image(renderer, state, number, option) for state in data]
        return images

    def _mesh_renderer(self, width: int, height: int) -> Any:
        """MuJoCo's renderer for a size, without antialiasing, which would mix surfaces with the sky."""
        if (width, height) not in self._renderers:
            visual = self._model.vis
            before = visual.global_.offwidth, visual.global_.offheight, visual.quality.offsamples
            visual.global_.offwidth, visual.global_.offheight = max(width, before[0]), max(height, before[1])
            visual.quality.offsamples = 0
            try:
                self._renderers[width, height] = mujoco.Renderer(self._model, height, width)
            except Exception as error:  # OpenGL platforms raise various classes
                raise InputError(
                    f"OpenGL must be usable by MuJoCo to render meshes, got {error}; without a display set "
                    "MUJOCO_GL=egl or MUJOCO_GL=osmesa before MuJoCo is imported"
                ) from error
            finally:
                visual.global_.offwidth, visual.global_.offheight, visual.quality.offsamples = before
        return self._renderers[width, height]


def _mesh_image(renderer: Any, data: Any, camera: int, option: Any) -> ExternalDepth:
    """Colours, depths and labels of the geoms of an environment; the sky is empty."""
    renderer.update_scene(data, camera=camera, scene_option=option)
    rgb = renderer.render()
    renderer.enable_depth_rendering()
    depth = renderer.render()
    renderer.disable_depth_rendering()
    renderer.enable_segmentation_rendering()
    objects = renderer.render()[..., 0]
    renderer.disable_segmentation_rendering()
    return ExternalDepth(
        rgb,
        np.where(objects >= 0, depth + np.float32(MESH_OFFSET), 0.0),
        np.minimum(MESH_LABEL - objects, MESH_LABEL),
    )


def camera_of(model: Any, name: str, default: bool = True) -> RigCamera:
    """RigCamera of a MuJoCo camera. A camera without a resolution has the size of the off-screen buffer.

    default: whether to use the outputs that the model declares.
    """
    number = model.camera(name).id
    width, height = map(int, model.cam_resolution[number])
    if (width, height) == (1, 1):
        width, height = int(model.vis.global_.offwidth), int(model.vis.global_.offheight)
    size = np.array([width, height], float)
    fovy, physical = float(model.cam_fovy[number]), np.asarray(model.cam_sensorsize[number], float)
    center, lens = size / 2, None
    if model.cam_projection[number] == mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC:
        focal, lens = np.full(2, height / fovy), Orthographic()  # fovy of an orthographic camera is in metres
    elif physical.all():
        focal_length, shift = np.split(np.asarray(model.cam_intrinsic[number], float), 2)
        focal = focal_length / physical * size
        center = center - shift / physical * size
    else:
        focal = np.full(2, height / 2 / math.tan(math.radians(fovy) / 2))
    camera = Camera(width, height, *focal.tolist(), *center.tolist(), lens=lens)
    return RigCamera(camera, outputs=_outputs_of(model, number) if default else None)


def _outputs_of(model: Any, number: int) -> tuple[str, ...] | None:
    bits = int(model.cam_output[number])
    return (
        tuple(ours for theirs, ours in _OUTPUTS.items() if bits & int(getattr(mujoco.mjtCamOutBit, theirs)))
        or None
    )


def _arrays_of(data: Any, bodies: int, cameras: int) -> list[np.ndarray]:
    """Positions (env, n, 3), quaternions (env, n, 4) of the model's bodies, positions and axes (env, n, 3, 3)
    of its cameras."""
    arrays = []
    kinds = ("xpos", 3, bodies), ("xquat", 4, bodies), ("cam_xpos", 3, cameras), ("cam_xmat", 9, cameras)
    for name, width, count in kinds:
        array = getattr(data, name, None)
        if array is None:
            raise InputError(f"data must be a mujoco.MjData or mujoco_warp's Data, got {data!r}")
        host = array.numpy() if hasattr(array, "numpy") else array  # a wp.array, or NumPy
        numbers = np.asarray(host, np.float64)
        rows = numbers.shape[0 if numbers.ndim == 2 else 1]  # worlds are first
        if rows != count:
            raise InputError(
                f"data.{name} must have {count} rows as the rig's model, got {rows}; give data of that model"
            )
        numbers = numbers.reshape(-1, count, width)
        arrays.append(numbers)
    arrays[3] = arrays[3].reshape(*arrays[3].shape[:2], 3, 3)
    return arrays
