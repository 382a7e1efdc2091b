"""Isaac Lab's camera interface (`TiledCamera`, in Isaac Lab 3.0 `Camera`) for rigs.

Follows the documentation of Isaac Lab 3.0 and 2.3; Isaac Lab itself is not needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.sim.poses import IDENTITY, OPENGL, OPTICAL, compose, inverse, pose_of
from fidsplat.sim.rig import Rig, _known
from fidsplat.util.arguments import instance, whole_number
from fidsplat.util.errors import InputError

_FROM_ROS = {"world": OPTICAL, "ros": IDENTITY, "opengl": OPENGL}
"""(7,) axes of the convention from OpenCV axes"""
_OUTPUTS = {
    "rgb": "rgb",
    "rgba": "rgb",
    "depth": "depth",
    "distance_to_image_plane": "depth",
    "distance_to_camera": "distance",
    "normals": "normal_world",
    "semantic_segmentation": "label",
}
"""our output of each data type"""


@dataclass
class CameraData:
    """Data of the cameras of all environments as torch tensors, by the names of Isaac Lab.

    Poses (N, 3) and (N, 4) are in the world of the simulation, with axes x forward, z up (world), z forward,
    y down (ros) or -z forward, y up (opengl). `output` has images (N, h, w, channels) by data type: rgb and
    rgba uint8, semantic_segmentation int32, else float32; `info` has None for each.
    """

    image_shape: tuple[int, int]
    intrinsic_matrices: Any
    pos_w: Any
    quat_w_world: Any
    quat_w_ros: Any
    quat_w_opengl: Any
    output: dict[str, Any]
    info: dict[str, Any]


class TiledCamera:
    """A camera in each environment, with the interface of Isaac Lab's `TiledCamera`.

    Images are torch tensors on the device of the renderer, without a copy to the host if it is a Warp device.

    Args:
        rig: splats, markers and one camera.
        num_instances: N, number of environments.
        data_types: rgb, rgba, depth, distance_to_image_plane, distance_to_camera (infinite for empty pixels),
            normals (world axes) and semantic_segmentation (labels of splats, -1 for none).
        bodies: function that returns the current poses {name: (N, 7)} of the rig's bodies in the world of the
            simulation, for example of `RigidObject.data.root_pose_w`; arrays of torch, Warp or NumPy.
        origins: (N, 3) positions of the environments (`scene.env_origins`); splats are relative to them.
        update_period: seconds between images; 0: new images in every step.
        quaternions: order of all quaternions: xyzw (Isaac Lab 3.0) or wxyz (2.x).

    Raises:
        InputError: a rig with several cameras, bodies without `bodies`, no or an unknown data type, or
            origins of another number.
    """

    def __init__(
        self,
        rig: Rig,
        num_instances: int,
        data_types: Sequence[str] = ("rgb",),
        *,
        bodies: Callable[[], Mapping[str, Any]] | None = None,
        origins: Any = None,
        update_period: float = 0.0,
        quaternions: Literal["xyzw", "wxyz"] = "xyzw",
    ) -> None:
        instance("rig", rig, Rig)
        if len(rig.cameras) != 1:
            raise InputError(f"the rig of a TiledCamera must have one camera, got {', '.join(rig.cameras)}")
        if rig.bodies and bodies is None:
            raise InputError(f"bodies must return the poses of {', '.join(rig.bodies)}, got None")
        _known("order of quaternions", quaternions, ("xyzw", "wxyz"))
        for name in data_types or (None,):
            _known("data type", name, _OUTPUTS)
        self.num_instances = whole_number("num_instances", num_instances, 1, 2**31 - 1)
        self._rig, self._types, self._bodies, self._period = rig, tuple(data_types), bodies, update_period
        (self._name,) = rig.cameras
        origins = np.zeros((num_instances, 3)) if origins is None else _host(origins)
        if origins.shape != (num_instances, 3):
            raise InputError(f"origins must have the shape ({num_instances}, 3), got {origins.shape}")
        self._origins = np.concatenate([origins, np.tile(IDENTITY[3:], (len(origins), 1))], -1)
        self._to_wxyz = [0, 1, 2, 3] if quaternions == "wxyz" else [3, 0, 1, 2]
        self._from_wxyz = np.argsort(self._to_wxyz)
        self._poses: np.ndarray | None = None
        """(N, 7) poses in the world of the simulation that `set_world_poses` has set"""
        self._tensors: dict[str, Any] = {}
        self.frame = np.zeros(num_instances, np.int64)
        """number of images of each environment since its reset"""
        self._times, self._taken = np.zeros((2, num_instances))
        self._outdated = np.ones(num_instances, bool)
        self._camera = rig.cameras[self._name].camera
        self.image_shape = self._camera.height, self._camera.width

    @property
    def data(self) -> CameraData:
        """The current data; renders environments whose images are outdated."""
        bodies = self._body_poses()
        if self._outdated.any():
            self._render(bodies, self._world_poses(bodies))
        poses, camera = self._world_poses(bodies), self._camera
        tensor = next(iter(self._tensors.values())).new_empty(0).float().new_tensor  # on the images' device
        order = 3 + self._from_wxyz
        world, ros, opengl = (tensor(compose(poses, inverse(axes))[:, order]) for axes in _FROM_ROS.values())
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        intrinsics, images = tensor([matrix] * len(poses)), dict(self._tensors)
        position, info = tensor(poses[:, :3]), dict.fromkeys(images)
        return CameraData(self.image_shape, intrinsics, position, world, ros, opengl, images, info)

    def update(self, dt: float, force_recompute: bool = False) -> None:
        """Advance the time; images of environments whose period has passed are rendered when `data` is read,
        or now if `force_recompute`."""
        self._times += dt
        self._outdated |= self._times - self._taken + 1e-6 >= self._period
        if force_recompute:
            self._outdated[:] = True
            _ = self.data

    def reset(self, env_ids: Any = None, env_mask: Any = None) -> None:
        """Set the time and the image count of environments to 0, and mark their images as outdated. env_mask:
        (N,) bool, instead of env_ids."""
        which = self._which(env_ids if env_mask is None else env_mask)
        self.frame[which] = self._times[which] = self._taken[which] = 0
        self._outdated[which] = True

    def set_world_poses(
        self,
        positions: Any = None,
        orientations: Any = None,
        env_ids: Any = None,
        convention: Literal["opengl", "ros", "world"] = "ros",
    ) -> None:
        """Set positions (n, 3) and orientations (n, 4) in the world of the simulation, instead of the
        camera's mount; None: unchanged. convention: axes of the orientations, as in `CameraData`."""
        _known("convention", convention, _FROM_ROS)
        which, poses = self._which(env_ids), self._world_poses(self._body_poses())
        if positions is not None:
            poses[which, :3] = _host(positions)
        if orientations is not None:
            rotations = np.zeros((len(poses[which]), 7))
            rotations[:, 3:] = _host(orientations)[..., self._to_wxyz]
            poses[which, 3:] = compose(rotations, _FROM_ROS[convention])[:, 3:]
        self._poses = poses
        self._outdated[which] = True

    def set_world_poses_from_view(self, eyes: Any, targets: Any, env_ids: Any = None) -> None:
        """Set poses from eyes and targets (n, 3); z is up."""
        eyes, targets = _host(eyes).reshape(-1, 3), _host(targets).reshape(-1, 3)
        poses = [
            inverse(pose_of(Camera.look_at(2, 2, 1.0, eye, target, up=(0, 0, 1)).world_to_camera))
            for eye, target in zip(eyes, targets, strict=True)
        ]
        self.set_world_poses(eyes, np.array(poses)[:, 3:][:, self._from_wxyz], env_ids)

    def _which(self, env_ids: Any) -> Any:
        """Index of environments: all for None; a mask is not converted to numbers."""
        if env_ids is None or isinstance(env_ids, slice):
            return slice(None) if env_ids is None else env_ids
        which = _host(env_ids, None)
        return which if which.dtype == bool else which.astype(int)

    def _body_poses(self) -> dict[str, np.ndarray]:
        """Poses (N, 7) of the bodies in the world of the simulation."""
        current = {} if self._bodies is None else self._bodies()
        order = [0, 1, 2, *(3 + k for k in self._to_wxyz)]
        return {name: _host(poses)[:, order] for name, poses in current.items()}

    def _world_poses(self, bodies: Mapping[str, np.ndarray]) -> np.ndarray:
        """Poses (N, 7) of the cameras in the world of the simulation, OpenCV axes."""
        if self._poses is not None:
            return self._poses.copy()
        if self._rig.cameras[self._name].body is None:
            return compose(self._origins, self._rig.cameras[self._name].mount)
        return self._rig._mounted_pose(self._name, bodies, self.num_instances)

    def _render(self, bodies: Mapping[str, np.ndarray], poses: np.ndarray) -> None:
        mask, back = self._outdated.copy(), inverse(self._origins)
        images = Rig.render(
            self._rig,
            {name: compose(back, pose) for name, pose in bodies.items()},
            {self._name: compose(back, poses)},
            outputs=[*(_OUTPUTS[name] for name in self._types), *["alpha"] * ("rgba" in self._types)],
            mask=mask,
        ).of(self._name)
        rest = np.flatnonzero(~mask).tolist()
        for name in self._types:
            tensor = self._tensor(name, images)
            if rest:  # the first images contain all environments
                tensor[rest] = self._tensors[name][rest]
            self._tensors[name] = tensor  # tensors that were returned before keep their images
        self.frame[mask] += 1
        self._taken[mask] = self._times[mask]
        self._outdated[:] = False

    def _tensor(self, name: str, images: Any) -> Any:
        """The tensor (N, h, w, channels) of a data type."""
        image = images.to_torch(_OUTPUTS[name])
        if name == "rgba":
            rgb, image = image, image.new_empty((*image.shape[:3], 4))
            image[..., :3], image[..., 3] = rgb, images.to_torch("alpha")
        if _OUTPUTS[name] == "rgb":
            return (image.clamp(0, 1) * 255).round().byte()
        if _OUTPUTS[name] in ("depth", "distance"):
            image = image.masked_fill(image == 0, float("inf"))
        return image if image.ndim == 4 else image.unsqueeze(-1)


def _host(value: Any, dtype: Any = np.float64) -> np.ndarray:
    """Convert an array of torch, Warp or Isaac Lab (`ProxyArray`) to NumPy, on the host."""
    value = getattr(value, "torch", value) if not isinstance(value, np.ndarray) else value
    if hasattr(value, "detach"):
        value = value.detach().cpu()
    return np.array(value.numpy() if hasattr(value, "numpy") else value, dtype)
