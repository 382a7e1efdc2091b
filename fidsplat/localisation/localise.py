"""Localisation of a camera in a scene from one image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.capture.capture import Capture
from fidsplat.capture.sensor import Sensor
from fidsplat.images.files import pixels_of
from fidsplat.localisation.direct_alignment import MAX_SIDE, MIN_INLIERS, MIN_SIDE, align
from fidsplat.localisation.initial_pose import most_similar, pose_of_markers, repeated_markers
from fidsplat.localisation.normal_equations import rendered_scene
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.store.store import Store
from fidsplat.util.arguments import instance, invalid, whole_number
from fidsplat.util.errors import InputError

MAX_VALUE = 100.0
"""maximum display value of an image: floats from 0 to 255 are an error"""
MAX_DEVIATION = 0.01
"""radians: maximum standard deviation of the rotation of a found pose"""
MIN_CONFIRMED_INLIERS, CONFIRMED = 0.4, 2e-3
"""minimum fraction of matching blocks of a found pose whose marker error or standard deviation of the
rotation is at most this angle [rad]"""
TRIED = 3
"""number of candidates that are aligned coarsely"""


@dataclass(frozen=True, eq=False)
class Localisation:
    """Pose of a camera in a scene."""

    camera: Camera
    """camera of the image at its pose"""
    covariance: np.ndarray
    """(6, 6) covariance of a rotation vector [rad] and a translation [m] applied after `world_to_camera`, in
    camera axes, as the gradient `pose`; infinite if the image does not determine the pose"""
    inliers: float
    """fraction, 0 to 1, of the textured blocks of the image that match the scene (normalised correlation
    above 0.7)"""
    noise: float
    """standard deviation of the residuals of a pixel, display values"""
    start: str
    """source of the initial pose: `start`, `candidates`, or names of the detected markers"""
    marker_error: float | None = None
    """RMS angle [rad] between detected corners of markers and their projections at the pose; None if the
    pose did not start from markers"""

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) world_to_camera."""
        return self.camera.world_to_camera

    @property
    def found(self) -> bool:
        """Whether `angle_deviation` is at most 10 milliradians, and at least 0.6 of the image's textured
        blocks match the scene, or 0.4 if `angle_deviation` or `marker_error` is at most 2 milliradians."""
        angle = self.angle_deviation
        confirmed = angle <= CONFIRMED or (self.marker_error is not None and self.marker_error <= CONFIRMED)
        return (
            self.inliers >= (MIN_CONFIRMED_INLIERS if confirmed else MIN_INLIERS) and angle <= MAX_DEVIATION
        )

    @property
    def position_deviation(self) -> float:
        """Standard deviation of the position [m], root of the sum over the axes."""
        return math.sqrt(float(np.trace(self.covariance[3:, 3:])))

    @property
    def angle_deviation(self) -> float:
        """Standard deviation of the rotation [rad], root of the sum over the axes."""
        return math.sqrt(float(np.trace(self.covariance[:3, :3])))

    def as_dict(self) -> dict[str, Any]:
        """Values for JSON, in metres, millimetres and degrees."""
        return {
            "found": self.found,
            "start": self.start,
            "position": self.camera.position.tolist(),
            "quaternion": matrix_to_quaternion(self.camera.camera_to_world[:3, :3]).tolist(),
            "world_to_camera": self.pose.tolist(),
            "covariance": self.covariance.tolist(),
            "position_deviation_mm": 1e3 * self.position_deviation,
            "angle_deviation_deg": math.degrees(self.angle_deviation),
            "inliers": self.inliers,
            "noise": self.noise,
            "marker_error_deg": None if self.marker_error is None else math.degrees(self.marker_error),
        }


def localise(
    image: np.ndarray,
    scene: Scene | SplatCloud | ResidentCloud | Store,
    start: Camera | np.ndarray | Sequence[Any] | None = None,
    *,
    camera: Camera | None = None,
    candidates: Sequence[Camera] = (),
    mask: np.ndarray | None = None,
    max_side: int = MAX_SIDE,
    renderer: Renderer | None = None,
    resident: ResidentCloud | None = None,
) -> Localisation:
    """Find the pose at which a camera took an image of a scene.

    Renders of the scene are aligned with the image from coarse to fine, with robust weights and a gain and
    an offset for each channel, so that exposure and white balance do not matter.

    ```python
    found = fs.localise(image, scene, start=pose)
    found.pose, found.covariance, found.inliers
    ```

    Args:
        image: (h, w, 3) or (h, w), uint8 or float display values.
        scene: the scene.
        start: initial pose, world_to_camera (4, 4) or (position, quaternion w, x, y, z), or a Camera there.
            None: estimated from the scene's markers in the image, or else the best of `candidates`.
        camera: size, intrinsics and lens of the image; None: those of `start` if it is a Camera, else the
            scene's camera.
        candidates: cameras at possible poses, e.g. of the photographs of the scene.
        mask: (h, w) bool, False for ignored pixels, e.g. people.
        max_side: larger images are reduced to this number of pixels along the larger side. More pixels are
            more accurate and take longer.
        renderer: device; None: the default device.
        resident: the scene uploaded by `renderer`, to localise many images.

    Raises:
        InputError: no camera, an image of another size than the camera's, or no initial pose: no start, no
            known marker in the image and no candidate.
        DeviceError: the device fails or lacks memory.
    """
    pixels, max_side = _pixels(image), whole_number("max_side", max_side, MIN_SIDE, 32_767)
    kinds = Scene | SplatCloud | ResidentCloud | Store
    instance("scene", scene, kinds, "a Scene, a SplatCloud, a Store or a ResidentCloud")  # type: ignore[arg-type]
    renderer = Renderer() if renderer is None else instance("renderer", renderer, Renderer)
    capture = scene.capture if isinstance(scene, (Scene, ResidentCloud)) else Capture()
    if camera is None:
        camera = start if isinstance(start, Camera) else capture.camera
    if camera is None:
        raise InputError("the image must have a camera, got none; give camera= with its size and intrinsics")
    instance("camera", camera, Camera)
    if pixels.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"the image must have the camera's size, {camera.width} x {camera.height} pixels, got "
            f"{pixels.shape[1]} x {pixels.shape[0]}; give the image in its original size, or its camera"
        )
    if mask is not None:
        given, mask = mask, np.asarray(mask)
        if mask.shape != pixels.shape[:2] or mask.dtype != bool:
            raise invalid("mask", f"an array {pixels.shape[:2]} of bool, False for ignored pixels", given)
    if resident is not None:
        instance("resident", resident, ResidentCloud)
    capture = _plain(capture)
    uploaded = (
        resident
        if resident is not None
        else renderer.upload(scene)
        if not isinstance(scene, ResidentCloud)
        else scene
    )
    rendered = rendered_scene(renderer, uploaded, capture)
    source, starts, detected = "start", [], None
    if start is not None:
        pose = start.world_to_camera if isinstance(start, Camera) else start
        starts = [camera.with_pose(pose)]
    elif isinstance(scene, Scene) and (detected := pose_of_markers(pixels, scene, camera)) is not None:
        starts, source = [detected.camera], ", ".join(detected.names)
    if not starts:
        if not len(candidates):
            repeated = repeated_markers(scene) if isinstance(scene, Scene) else []
            unused = f" ({', '.join(repeated)} more than once)" if repeated else ""
            raise InputError(
                "localisation must have an initial pose, got no start, no marker in the image that occurs "
                f"once in the scene{unused} and no candidates; give start= or candidates="
            )
        source = "candidates"

        def render_all(at: list[Camera]) -> np.ndarray:
            return renderer.render_batch(
                uploaded, [capture.with_(camera=camera, outputs="rgb") for camera in at]
            )["rgb"]

        best = most_similar(pixels, camera, candidates, render_all, TRIED)
        tried = [align(pixels, mask, start, rendered, coarse=True) for start in best]
        starts = [min(tried, key=lambda alignment: alignment.noise).camera]
    alignment = align(pixels, mask, starts[0], rendered, max_side=max_side)
    error = None if detected is None else detected.error(alignment.camera)
    return Localisation(
        alignment.camera, alignment.covariance, alignment.inliers, alignment.noise, source, error
    )


@lru_cache(maxsize=8)
def _plain(capture: Capture) -> Capture:
    """The capture without sensor and motion; the same object for the same capture."""
    return capture.with_(outputs=("rgb", "depth"), motion=Motion(), shutter=Shutter(), sensor=Sensor())


def _pixels(image: Any) -> np.ndarray:
    """An image (h, w, 3) or (h, w, 1), uint8 or float32 display values."""
    pixels = pixels_of(image)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3) or pixels.dtype.kind not in "fu" or not pixels.size:
        raise InputError(
            f"the image must be (h, w) or (h, w, 3) of uint8 or floats, got {pixels.dtype} {pixels.shape}"
        )
    if pixels.dtype.kind == "u" and pixels.dtype != np.uint8:
        raise InputError(f"the image must be uint8 or floats, got {pixels.dtype}; convert it first")
    if pixels.dtype == np.uint8:
        return pixels
    values = pixels.astype(np.float32)
    largest = float(np.abs(values).max())
    if not largest <= MAX_VALUE:
        raise InputError(
            f"display values of the image must be finite and at most {MAX_VALUE:g}, got {largest:g}; give "
            "uint8, or divide floats so that white is 1"
        )
    return values
