"""A picture and its derivatives in NumPy, on any device that has some; a pose as a motion of six numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from fidsplat.backends.derivatives import Differentiates
from fidsplat.backends.gradients import on_host
from fidsplat.backends.prepare import prepare
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.effects.differentiable import check_gradients
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.errors import DeviceError

Arrays = dict[str, np.ndarray]
_STRAIGHT = 1e-3
"""radians, below which the first term of a series is as good as the formula"""


def drawn(
    renderer: Renderer, cloud: SplatCloud, capture: Capture
) -> tuple[Arrays, Callable[[Mapping[str, np.ndarray]], Arrays]]:
    """The output images of a capture, and what gives the derivatives of a loss by the splats, the background
    and the pose from those by the images (`DifferentiablePipeline.backward`): before the next picture.

    Raises:
        DeviceError: the device has no gradients, or fails.
        InputError: an effect or an output of the capture has no gradient.
    """
    backend = renderer.backend
    if not isinstance(backend, Differentiates):
        raise DeviceError(
            f"{renderer.device.name} has no gradients; use device='opencl', 'warp' or 'reference'"
        )
    resident = backend.upload(cloud)
    features, view = prepare(resident, capture)
    check_gradients(features, capture.outputs)
    pipeline = backend.differentiate(features)
    images = pipeline.forward(resident, view)

    def backward(by_images: Mapping[str, np.ndarray]) -> Arrays:
        return {name: on_host(array) for name, array in pipeline.backward(images, by_images).items()}

    return {name: images.read(name) for name in capture.outputs}, backward


def moved(camera: Camera, pose: np.ndarray) -> Camera:
    """The camera after a motion (6,) in its own axes: rotation vector [rad], then translation [m]."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = _rotation(pose[:3]), pose[3:]
    return replace(camera, world_to_camera=motion @ camera.world_to_camera, position=None)


def by_pose(by_motion: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Derivatives (6,) by the numbers of a motion, from those by another that follows it, at which `drawn`
    has them: R(w + dw) = R(J dw) R(w), and J's transpose takes them back (the left Jacobian of SO(3))."""
    turn, shift = pose[:3], pose[3:]
    by_turn = by_motion[:3] - np.cross(shift, by_motion[3:])
    angle = float(np.linalg.norm(turn))
    first = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    second = 1 / 6 if angle < _STRAIGHT else (1 - np.sinc(angle / np.pi)) / angle**2
    across = np.cross(turn, by_turn)
    return np.concatenate([by_turn - first * across + second * np.cross(turn, across), by_motion[3:]])


def _rotation(vector: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of a rotation vector (3,)."""
    half = float(np.linalg.norm(vector)) / 2
    return quaternion_to_matrix(np.concatenate([[np.cos(half)], np.sinc(half / np.pi) / 2 * vector]))
