"""Simulated depth cameras: active stereo, time of flight and structured light, with the errors and holes of
real devices.

Each measures a rendered scene by its own principle: a matched pair of images with a projected pattern,
phasors averaged over a pixel's footprint, or a disparity to a projector. Errors by distance, reflectance,
incidence and at edges follow from the principle and a few parameters of the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fidsplat.cameras import Camera, Motion
from fidsplat.capture.capture import Capture
from fidsplat.capture.sensor import LUMINANCE, Sensor
from fidsplat.images.stereo import disparity_of
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.util.arguments import instance, number, whole_number
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.response import linear_light

DOT = 3.0
"""pixels between the random values of the projected pattern"""

MEAN = 0.35
"""target mean of the central half of the images of active stereo, relative to full scale"""

SHADOW = 0.02
"""relative difference of depths from which a point is in the shadow of the projector"""


class DepthView(NamedTuple):
    """Images of a scene from which a depth camera measures."""

    depth: np.ndarray
    """(h, w) float64 metres along z, 0 without a surface"""
    grey: np.ndarray
    """(h, w) reflectance, 0 to 1: luminance of the rendered colours, as light"""
    cosine: np.ndarray
    """(h, w) cosine of the angle of incidence, from the camera"""


class DepthCamera:
    """Base of the depth cameras, which are dataclasses of their parameters."""

    near: float
    far: float

    def measure(self, renderer: Renderer, scene: Scene, camera: Camera, seed: int = 0) -> np.ndarray:
        """Measured depth (h, w) float32 in metres along z, 0 in holes.

        Args:
            camera: a pinhole without lens, e.g. of `depth_camera`; replaces the scene's.
            seed: seed of the noise; use another one for each frame.

        Raises:
            InputError: a camera with a lens, or an invalid seed.
        """
        instance("renderer", renderer, Renderer, remedy="fs.Renderer('opencl') opens a device")
        instance("scene", scene, Scene, remedy="fs.Scene([cloud]) makes one of splats")
        instance("camera", camera, Camera)
        if camera.lens is not None:
            raise InputError(f"a depth camera must be a pinhole without lens, got {camera.lens.kind}")
        rng = np.random.default_rng(whole_number("seed", seed, 0, 2**63 - 1))
        depth = self._measured(renderer, scene, camera, rng)
        valid = (depth >= self.near) & (depth <= self.far)
        return np.where(valid, depth, 0.0).astype(np.float32)

    def _measured(
        self, renderer: Renderer, scene: Scene, camera: Camera, rng: np.random.Generator
    ) -> np.ndarray:
        """Measured depth (h, w) without range limits; 0 or NaN in holes."""
        raise NotImplementedError


def _check_range(device: DepthCamera) -> None:
    number("near", device.near, "a distance in metres", 0)
    number("far", device.far, "a distance in metres above near", device.near)


@dataclass(frozen=True)
class ActiveStereo(DepthCamera):
    """Active stereo: depth of the left of two infrared cameras, with a projector of random dots between them.

    The images of both cameras are rendered, lit by ambient light and the pattern, and matched by OpenCV's
    semi-global matching. The defaults are those of an Intel RealSense D435: its error is about 0.08 pixels of
    disparity, z^2 0.08 / (f baseline) in depth (Grunnet-Jepsen, librealsense issue 3904).
    """

    baseline: float = 0.05
    """metres from the left to the right camera"""
    pattern: float = 1.0
    """brightness of dots on white paper at 1 m; falls with the squared distance"""
    ambient: float = 0.008
    """brightness of white paper by ambient light"""
    exposure: float = 32.0
    """largest factor of the automatic exposure"""
    noise: float = 0.047
    """standard deviation of the noise of the exposed images, relative to full scale"""
    max_disparity: int = 128
    """largest disparity in pixels, a multiple of 16; limits the nearest distance"""
    near: float = 0.1
    far: float = 10.0
    kind: ClassVar[str] = "active stereo"

    def __post_init__(self) -> None:
        number("baseline", self.baseline, "a positive length in metres", 1e-6)
        for name in ("pattern", "ambient", "exposure", "noise"):
            number(name, getattr(self, name), "0 to 1000 of full scale", 0, 1000)
        if whole_number("max_disparity", self.max_disparity, 16, 1024) % 16:
            raise InputError(f"max_disparity must be a multiple of 16 pixels, got {self.max_disparity}")
        _check_range(self)

    def _measured(
        self, renderer: Renderer, scene: Scene, camera: Camera, rng: np.random.Generator
    ) -> np.ndarray:
        # the projector is aimed so that it illuminates the nearest depth that stereo matching can find
        nearest = max(self.near, camera.fx * self.baseline / self.max_disparity)
        middle = _projector(camera, self.baseline / 2, nearest)
        cameras = (camera, _shifted(camera, self.baseline), middle)
        views = [_view(renderer, scene, view_camera) for view_camera in cameras]
        dots = rng.integers(0, 2, (1024, 1024))  # the device's pattern; each frame has another one
        lights = [self._light(views[i], cameras[i], middle, views[2].depth, dots) for i in (0, 1)]
        middle_half = lights[0][tuple(slice(n // 4, n - n // 4) for n in lights[0].shape)]
        exposure = min(MEAN / max(float(middle_half.mean()), 1e-9), self.exposure)
        noisy = [exposure * light + rng.normal(0, self.noise, light.shape) for light in lights]
        images = [np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8) for image in noisy]
        disparity = disparity_of(images[0], images[1], self.max_disparity)
        # surfaces of the two cameras are matched, never the empty background
        matched = (disparity > 0) & (views[0].depth > 0)
        return np.where(matched, camera.fx * self.baseline / np.where(matched, disparity, 1), 0)

    def _light(
        self, view: DepthView, camera: Camera, projector: Camera, shadow: np.ndarray, dots: np.ndarray
    ) -> np.ndarray:
        """Light (h, w) that one camera receives. shadow: depths of the projector's view."""
        x, y, depth = _projected_to(projector, camera, view.depth)
        lit = _lit(projector, shadow, x, y, depth)
        (i, a), (j, b) = (np.divmod(np.where(lit, at / DOT, 0.0), 1) for at in (y, x))
        i, j = i.astype(int) % (len(dots) - 1), j.astype(int) % (len(dots) - 1)
        above = (1 - b) * dots[i, j] + b * dots[i, j + 1]
        below = (1 - b) * dots[i + 1, j] + b * dots[i + 1, j + 1]
        bright = (1 - a) * above + a * below
        light = np.where(lit, self.pattern * bright / np.maximum(depth, 0.05) ** 2, 0.0)
        return view.grey * (self.ambient + light * view.cosine)


@dataclass(frozen=True)
class TimeOfFlight(DepthCamera):
    """Time of flight: depth from the phase of amplitude-modulated light.

    The phasors of `samples` x `samples` rays are summed by their light, so that pixels on an edge measure a
    depth between both surfaces (flying pixels). The noise is shot noise of the gathered light and a constant.
    Interreflections (multi-path) are not simulated. The defaults are those of an Azure Kinect, narrow field
    of view, unbinned: a standard deviation of 0.1 % of the distance to a light wall (DLR-RM/BlenderProc,
    `add_kinect_azure_noise`, after Toelgyessy et al. 2021), and the maker's range for 15 % reflectance.
    """

    noise: float = 0.95e-3
    """standard deviation of the distance in metres by shot noise, of white paper at 1 m"""
    floor: float = 0.0
    """metres: standard deviation of the rest of the noise"""
    frequency: float = 100e6
    """hertz: frequency of the modulation, which determines depths of mixed pixels"""
    faintest: float = 0.15 / 3.86**2
    """minimum light of a measured pixel: reflectance times cosine of incidence, divided by the squared
    distance"""
    brightest: float = 4.0
    """maximum light of a pixel, above which it saturates"""
    samples: int = 3
    """rays of a pixel along an edge"""
    near: float = 0.25
    far: float = 3.86
    kind: ClassVar[str] = "time of flight"

    def __post_init__(self) -> None:
        number("noise", self.noise, "a standard deviation of 0 to 1 m", 0, 1)
        number("floor", self.floor, "a standard deviation of 0 to 1 m", 0, 1)
        number("frequency", self.frequency, "1e6 to 1e9 hertz", 1e6, 1e9)
        number("faintest", self.faintest, "0 or more", 0)
        number("brightest", self.brightest, "above the faintest light", self.faintest)
        whole_number("samples", self.samples, 1, 8)
        _check_range(self)

    def _measured(
        self, renderer: Renderer, scene: Scene, camera: Camera, rng: np.random.Generator
    ) -> np.ndarray:
        fine = camera.resampled(camera.width * self.samples, camera.height * self.samples)
        view = _view(renderer, scene, fine)
        stretch = _stretch(fine)
        distance = view.depth * stretch
        light = view.grey * view.cosine / np.maximum(distance, 0.05) ** 2
        light = np.where(view.depth > 0, light, 0.0)
        wave = 4 * math.pi * self.frequency / 299_792_458
        phasor = _pooled(light * np.exp(1j * wave * distance), self.samples)
        total = _pooled(light, self.samples)
        mean = _pooled(light * distance, self.samples) / np.where(total > 0, total, 1)
        # several frequencies determine the whole period: that of the mean distance
        period = 2 * math.pi / wave
        phase = np.angle(phasor) / wave
        measured = phase + period * np.rint((mean - phase) / period)
        amplitude = np.abs(phasor)
        with np.errstate(divide="ignore"):
            deviation = np.sqrt(self.floor**2 + self.noise**2 / amplitude)
        valid = (amplitude >= self.faintest) & (total <= self.brightest)
        noisy = measured + np.where(valid, deviation, 0.0) * rng.normal(size=measured.shape)
        return np.where(valid, noisy / _stretch(camera), 0.0)


@dataclass(frozen=True)
class StructuredLight(DepthCamera):
    """Structured light: depth from a camera and a projector of a known pattern next to it.

    Depth is triangulated from a disparity in steps, with noise; points in the shadow of the projector, at
    grazing incidence or too dark have no depth, and edges are ragged by the size of the matched window. The
    defaults are those of a Kinect v1 (Khoshelham and Elberink 2012: 1.4 cm at 3 m, growing with z^2; Nguyen
    et al. 2012: lateral noise of 0.8 pixels).
    """

    baseline: float = 0.075
    """metres from the camera to the projector, along x"""
    step: float = 0.125
    """pixels: quantisation of the disparity"""
    noise: float = 0.05
    """pixels: standard deviation of the disparity before quantisation"""
    lateral: float = 0.8
    """pixels: standard deviation of the position of edges"""
    steepest: float = 70.0
    """degrees: largest angle of incidence"""
    faintest: float = 0.05 / 4.0**2
    """minimum light of a measured pixel: reflectance times cosine of incidence, divided by the squared
    distance"""
    near: float = 0.4
    far: float = 4.5
    kind: ClassVar[str] = "structured light"

    def __post_init__(self) -> None:
        number("baseline", self.baseline, "a positive length in metres", 1e-6)
        for name in ("step", "noise", "lateral"):
            number(name, getattr(self, name), "0 to 10 pixels", 0, 10)
        number("steepest", self.steepest, "0 to 90 degrees", 0, 90)
        number("faintest", self.faintest, "0 or more", 0)
        _check_range(self)

    def _measured(
        self, renderer: Renderer, scene: Scene, camera: Camera, rng: np.random.Generator
    ) -> np.ndarray:
        projector = _projector(camera, self.baseline, max(self.near, 0.1))
        view, shadow = (_view(renderer, scene, viewpoint) for viewpoint in (camera, projector))
        x, y, depth = _projected_to(projector, camera, view.depth)
        light = view.grey * view.cosine / np.maximum(view.depth, 0.05) ** 2
        valid = _lit(projector, shadow.depth, x, y, depth) & (light >= self.faintest)
        valid &= view.cosine >= math.cos(math.radians(self.steepest))
        h, w = view.depth.shape
        moved = np.rint(rng.normal(0, self.lateral, (2, h, w))).astype(int)
        rows = np.clip(np.arange(h)[:, None] + moved[0], 0, h - 1)
        columns = np.clip(np.arange(w) + moved[1], 0, w - 1)
        # the neighbour decides which surface is matched; use the depth of that surface's plane at this pixel
        other, center = view.depth[rows, columns], view.depth
        same = np.abs(other - center) < 0.05 * center
        depth, valid = np.where(same, center, other), np.where(same, valid, valid[rows, columns])
        strength = camera.fx * self.baseline
        disparity = strength / np.where(valid, depth, 1.0) + rng.normal(0, self.noise, (h, w))
        disparity = np.rint(disparity / self.step) * self.step if self.step else disparity
        return np.where(valid & (disparity > 0), strength / np.maximum(disparity, 1e-9), 0.0)


PRESETS: dict[str, tuple[DepthCamera, tuple[int, int, float]]] = {
    "d435": (ActiveStereo(), (848, 480, 90.0)),
    "azure-kinect": (TimeOfFlight(), (640, 576, 75.0)),
    "kinect-v1": (StructuredLight(), (640, 480, 57.8)),
}
"""depth cameras by name: parameters, width and height in pixels, horizontal field of view in degrees"""


def depth_camera(name: str, **pose: Any) -> tuple[DepthCamera, Camera]:
    """A depth camera by name, "d435", "azure-kinect" or "kinect-v1", and its pinhole.

    pose: arguments of `Camera.with_pose` for the pinhole; default the identity.

    Raises:
        InputError: an unknown name, or an invalid pose.
    """
    if not isinstance(name, str) or name not in PRESETS:
        raise InputError(unknown("depth camera", name, PRESETS))
    device, (width, height, angle) = PRESETS[name]
    focal = width / 2 / math.tan(math.radians(angle) / 2)
    camera = Camera.pinhole(width, height, focal, focal, width / 2, height / 2)
    return device, camera.with_pose(**pose) if pose else camera


def _view(renderer: Renderer, scene: Scene, camera: Camera) -> DepthView:
    """Depth, reflectance and incidence of a camera's image."""
    outputs = ("rgb", "depth_median", "normal")
    motion = Motion(None, scene.capture.motion.groups)  # none of the camera: each camera has its own pose
    capture: Capture = replace(
        scene.capture, camera=camera, motion=motion, outputs=outputs, sensor=Sensor(), fog=None
    )
    frame = renderer.render(scene, capture)
    rays = camera.rays(camera.pixel_centers.reshape(-1, 2)).reshape(camera.height, camera.width, 3)
    cosine = -(frame["normal"] * rays).sum(2) / np.linalg.norm(rays, axis=2)
    depth = frame["depth_median"].astype(np.float64)
    grey = linear_light(frame["rgb"], "srgb") @ LUMINANCE
    return DepthView(depth, np.clip(grey, 0, 1), np.clip(cosine, 0, 1))


def _shifted(camera: Camera, right: float) -> Camera:
    moved = camera.world_to_camera.copy()
    moved[0, 3] -= right
    return camera.with_pose(world_to_camera=moved)


def _projector(camera: Camera, right: float, near: float) -> Camera:
    """Projector to the right of a camera; its view contains the camera's view beyond the depth `near`."""
    moved = _shifted(camera, right)
    margin = math.ceil(camera.fx * abs(right) / near)
    return replace(moved, width=moved.width + 2 * margin, cx=moved.cx + margin)


def _stretch(camera: Camera) -> np.ndarray:
    """Distance along each pixel's ray per depth, (h, w)."""
    rays = camera.rays(camera.pixel_centers.reshape(-1, 2))
    return np.linalg.norm(rays / rays[:, 2:], axis=1).reshape(camera.height, camera.width)


def _pooled(values: np.ndarray, samples: int) -> np.ndarray:
    """Means of blocks of samples x samples."""
    h, w = values.shape
    return values.reshape(h // samples, samples, w // samples, samples).mean((1, 3))


def _projected_to(
    other: Camera, camera: Camera, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels x, y and depth (h, w) in another camera of the points of a depth image; cameras are parallel."""
    shift = (camera.world_to_camera - other.world_to_camera)[0, 3]
    x, y = np.moveaxis(camera.pixel_centers, -1, 0)
    moved = other.cx - camera.cx - camera.fx * shift / np.where(depth > 0, depth, math.inf)
    return x + moved, y, depth


def _lit(
    projector: Camera, shadow: np.ndarray, x: np.ndarray, y: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """Mask of the points that a projector lights, by the depths of its view."""
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < projector.width) & (row < projector.height)
    nearest = shadow[np.where(inside, row, 0), np.where(inside, column, 0)]
    return inside & (depth < nearest * (1 + SHADOW))
