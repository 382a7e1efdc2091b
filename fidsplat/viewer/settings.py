"""Settings of the viewer as plain data, and their captures."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np

from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import Fog
from fidsplat.capture.quality import Quality
from fidsplat.scenes import Scene
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError

LENSES = ("pinhole", "fisheye", "panorama", "parallel", "scene")
"""`fisheye` has a field of view of 180 degrees; `scene` is the lens of the scene's camera"""
AT_REST = ("rgb", "depth", "depth_median", "label", "splat_id")
"""outputs of the exact image, for clicks and for the occlusion of outlines"""
_MOVING = Quality.named("fast")
"""maximum quality while the camera moves"""
_FOG_COLOR = (0.7, 0.7, 0.7)
_MIN_SIDE, _MAX_SIDE = 16, 16384  # pixels


@dataclass(frozen=True)
class PageSettings:
    """Address and frame rate of the viewer's page.

    Raises:
        InputError: an unusable rate.
    """

    port: int = 8080
    """port of the page; 0 selects a free one"""
    host: str = "127.0.0.1"
    """address to listen on; 0.0.0.0 opens it to the network"""
    rate: float = 30.0
    """target frame rate while moving, in Hz"""

    def __post_init__(self) -> None:
        if not 0 < self.rate <= 1000:
            raise InputError(f"--rate must be above 0 and at most 1000 frames per second, got {self.rate:g}")


@dataclass(frozen=True)
class Viewpoint:
    """Camera of a browser, with OpenCV's axes."""

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    """w, x, y, z: camera to world"""
    fov_y: float
    """vertical field of view [rad]"""
    width: int
    """width and height of the page [px]"""
    height: int
    distance: float = 1.0
    """distance to the centre of rotation [m], where orthographic and pinhole images have the same width"""

    def __post_init__(self) -> None:
        numbers = (*self.position, *self.quaternion, self.fov_y, self.distance)
        if not all(math.isfinite(number) for number in numbers) or not any(self.quaternion):
            raise InputError(f"the page's camera must have finite numbers, got {numbers}; reload the page")
        if not 1e-3 <= self.fov_y <= math.pi - 1e-3:
            raise InputError(
                f"the page's field of view must be 0.001 to 3.14 radians, got {self.fov_y}; reload the page"
            )
        if not (1 <= self.width <= _MAX_SIDE and 1 <= self.height <= _MAX_SIDE):
            raise InputError(
                f"the page must be 1 to {_MAX_SIDE} pixels a side, got {self.width} x {self.height}; "
                "make it smaller"
            )

    @property
    def pose(self) -> np.ndarray:
        """Camera to world (4, 4)."""
        return rigid_matrix(self.position, self.quaternion)

    def camera(self, scene: Scene, lens: str = "pinhole", scale: float = 1.0) -> Camera:
        """The camera of an image of the page's size times `scale`.

        Raises InputError for an unknown lens.
        """
        width, height = (max(_MIN_SIDE, round(size * scale)) for size in (self.width, self.height))
        world_to_camera = np.linalg.inv(self.pose)
        world_to_camera[3] = 0, 0, 0, 1
        near = 0.01 if scene.camera is None else scene.camera.near
        far = math.inf if scene.camera is None else scene.camera.far
        if lens == "fisheye":
            return Camera.fisheye(width, height, math.pi, world_to_camera, near=near, far=far)
        if lens == "panorama":
            return Camera.equirectangular(width, height, world_to_camera, near, far)
        tall = 2 * math.tan(self.fov_y / 2)
        if lens == "parallel":
            across = self.distance * tall * width / height
            return Camera.orthographic(width, height, across, world_to_camera, near, far)
        if lens == "scene" and scene.camera is not None and scene.camera.lens is not None:
            f = scene.camera.fx * width / scene.camera.width
            ratio = scene.camera.fy / scene.camera.fx
            middle, scene_lens = (width / 2, height / 2), scene.camera.lens
            return Camera.pinhole(
                width, height, f, f * ratio, *middle, world_to_camera, near, far, lens=scene_lens
            )
        if lens not in ("pinhole", "scene"):
            raise InputError(f"unknown lens {lens!r}; known: {', '.join(LENSES)}")
        f = height / tall
        return Camera.pinhole(width, height, f, f, width / 2, height / 2, world_to_camera, near, far)


@dataclass(frozen=True)
class Settings:
    """Values of the controls."""

    device: str | None = None
    """name of the device; None: the scene's, or the default"""
    quality: str | None = None
    """preset of the quality; None: the scene's quality"""
    lens: str = "pinhole"
    fog: float = 0.0
    """density of the fog [1/m]"""
    exposure: float = 1.0
    """exposure factor of the sensor"""
    noise: float = 0.0
    """shot noise of white as a fraction of white; 0: none"""
    time: float = 0.0
    """seconds on the clock of the scene's motions"""
    exposure_ms: float = 0.0
    readout_ms: float = 0.0

    @staticmethod
    def of(scene: Scene, device: str | None = None) -> Settings:
        """The settings of a scene's own capture."""
        capture = scene.capture
        well = capture.sensor.full_well
        return Settings(
            device=device or scene.device,
            lens="pinhole" if scene.camera is None or scene.camera.lens is None else "scene",
            fog=0.0 if capture.fog is None else capture.fog.density,
            exposure=capture.sensor.exposure,
            noise=0.0 if math.isinf(well) else 1 / math.sqrt(well),
            time=capture.shutter.time,
            exposure_ms=1e3 * capture.shutter.exposure_time,
            readout_ms=1e3 * capture.shutter.readout,
        )

    def updated_from(self, before: Scene, after: Scene) -> Settings:
        """Settings after an edit of the scene file, with the values that the edit changes, except the
        device."""
        old, new = asdict(Settings.of(before)), asdict(Settings.of(after))
        edited = {name: value for name, value in new.items() if value != old[name] and name != "device"}
        return replace(self, **edited)

    def moving(self, scene: Scene, camera: Camera) -> Capture:
        """Capture while the camera moves: rgb only, one sample per pixel, at most the quality of `fast`."""
        capture = self.capture(scene, camera)
        quality = capture.quality
        coarse = quality.with_(
            alpha_cutoff=max(quality.alpha_cutoff, _MOVING.alpha_cutoff),
            transmittance_stop=max(quality.transmittance_stop, _MOVING.transmittance_stop),
            projection_precision=_MOVING.projection_precision,
            arithmetic=_MOVING.arithmetic,
            blend_precision=_MOVING.blend_precision,
            samples=1,
        )
        return replace(capture, outputs=("rgb",), quality=coarse)

    def capture(self, scene: Scene, camera: Camera) -> Capture:
        """Capture of the exact image. Raises InputError for a value out of range."""
        scene_capture = scene.capture
        color = _FOG_COLOR if scene_capture.fog is None else scene_capture.fog.color
        shutter = replace(
            scene_capture.shutter,
            time=self.time,
            exposure_time=self.exposure_ms / 1e3,
            readout=self.readout_ms / 1e3,
        )
        # the square of smaller noise may underflow to 0
        full_well = max(1.0, 1 / self.noise**2) if self.noise > 1e-9 else math.inf
        read_noise = 0.0 if math.isinf(full_well) else min(scene_capture.sensor.read_noise, full_well)
        sensor = replace(
            scene_capture.sensor, exposure=self.exposure, full_well=full_well, read_noise=read_noise
        )
        still = not scene.motion.groups
        return replace(
            scene_capture,
            camera=camera,
            outputs=AT_REST,
            quality=scene_capture.quality if self.quality is None else Quality.of(self.quality),
            motion=Motion(None, scene.motion.groups),
            shutter=Shutter() if still else shutter,
            sensor=sensor,
            fog=Fog(self.fog, color) if self.fog > 0 else None,
        )
