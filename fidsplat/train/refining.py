"""Marker refinement: optimise all Gaussians of a marker together, for sharp and opaque modules.

A template (`fidsplat.markers`) is a fixed set of Gaussians for one rectangle. Refinement optimises all splats
of a marker together in position (within its plane), scale, opacity and colour. Each iteration renders the
marker with splats sorted by their centres, as other renderers do, with a random tilt axis (which changes the
depth order), a random sub-pixel shift and a random grey background. The loss compares the image with the
printed marker and penalises transmitted light.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.images.apriltag3 import HOLE
from fidsplat.markers import Marker
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.arguments import as_float, callback, instance, invalid, whole_number
from fidsplat.util.errors import InputError

ITERATIONS = 1000
PIXELS = 12
"""pixels per module; random sub-pixel shifts cover details smaller than a pixel"""
MARGIN = 1
"""width of the empty border around the sheet, in modules"""
TILT = math.radians(3)
"""tilt [rad]; it changes the depth order of the splats but hardly the image"""
DISTANCE = 100.0
"""camera distance in edge lengths of the sheet; large, for almost no perspective"""
QUALITY = Quality(order="centre", lowpass="none", alpha_cutoff=1 / 255, transmittance_stop=1e-6)
OPAQUE = 8.0
"""optical depth from which there is no penalty (a transmittance of 3e-4)"""
LEAK = 0.05
"""weight of squared missing optical depth, relative to squared colour errors"""
RATES = {"positions": 0.003, "log_scales": 0.01, "logits": 0.1, "colors": 0.01}
"""learning rates, in modules, natural logarithms, logits and colours"""
BETA1, BETA2 = 0.9, 0.99
MIN_SCALE, MAX_SCALE = 0.008, 3.0
"""limits of the scales, in modules"""
SLOW = 0.15
"""scale in modules below which the learning rate of the position is proportional to the scale"""
MAX_LOGIT = 7.0


class RefineStep(NamedTuple):
    """Result of one iteration."""

    iteration: int
    """number of the iteration, from 1"""
    psnr: float
    """PSNR of the sheet with a border of one module [dB]"""
    transmittance: float
    """maximum transmittance on the sheet"""


def refine(
    marker: Marker,
    renderer: Renderer | None = None,
    iterations: int = ITERATIONS,
    leak: float = LEAK,
    seed: int = 0,
    progress: Callable[[RefineStep], Any] | None = None,
) -> Marker:
    """Optimise all Gaussians of a marker (`Marker.gaussians`) together; the result has the mixture "refined".

    The number of splats stays the same; start with `template=121`. Bit-identical on every run of a device.

    Args:
        marker: a marker of `fs.marker`, flat, without wear and slanted edges.
        renderer: device to optimise on; None: the default device.
        iterations: number of frames, 1 to 100,000.
        leak: weight of transmitted light, 0 to 1: squared missing optical depth relative to squared colour
            errors. Few splats cannot be both opaque and sharp: use 0.001 for the 25 per rectangle of the
            default template.
        seed: seed of the tilts, shifts and greys.
        progress: called after each iteration.

    Raises:
        DeviceError: the device has no gradients.
        InputError: a marker with slanted edges, a shape or wear, a number outside its range, or more
            Gaussians than the marker's ``max_splats``.
    """
    start = time.perf_counter()
    instance("marker", marker, Marker, "what fs.marker returns")
    if renderer is not None and not hasattr(renderer, "backend"):
        raise invalid("renderer", "an fs.Renderer or None", renderer)
    callback("progress", progress)
    iterations = whole_number("iterations", iterations, 1, 100_000)
    if not 0 <= as_float(leak) <= 1:
        raise InputError(f"leak must be a number from 0 to 1, got {leak!r}")
    seed = whole_number("the seed", seed, 0, 2**63 - 1)
    if marker.regions is not None:
        raise InputError(
            f"marker must consist of square modules, got the drawing {marker.spec}, with edges across its "
            "modules; give a tag, a QR code or an image"
        )
    if marker.shape is not None or marker.wear is not None:
        raise InputError(f"marker must be flat and not worn, got {marker.spec}; leave out shape and wear")
    renderer = Renderer() if renderer is None else renderer
    sheet = _Sheet(marker, float(leak))
    splats = _Parameters.of(marker)
    rng = np.random.default_rng(seed)
    for iteration in range(1, iterations + 1):
        camera, grey = sheet.camera(rng), np.full(3, rng.random())
        capture = Capture(camera, outputs=("rgb", "alpha"), quality=QUALITY, background=tuple(grey))
        frame = renderer.render_differentiable(splats.cloud(), capture)
        by_images, psnr, through = sheet.gradients(camera, frame["rgb"], frame["alpha"], grey)
        splats.step(frame.backward(by_images), iteration, _rate_factor(iteration / iterations))
        if progress is not None:
            progress(RefineStep(iteration, psnr, through))
    return replace(
        marker,
        mixture="refined",
        cloud=splats.cloud(marker.module).with_coplanar_groups(0),
        seconds=marker.seconds + time.perf_counter() - start,
    )


def _rate_factor(done: float) -> float:
    """Learning rate schedule: constant for the first half, then a cosine to 3 %."""
    return 1.0 if done < 0.5 else 0.03 + 0.485 * (1 + math.cos(math.pi * (2 * done - 1)))


class _Sheet:
    """Printed marker, the ground truth of the images, in modules from its centre."""

    def __init__(self, marker: Marker, leak: float) -> None:
        self._leak, self._shape = leak, np.array(marker.grid.shape)
        self._inside = np.pad(marker.grid != HOLE, 1)
        values = np.where(marker.grid == HOLE, 0, marker.grid)
        self._colors = np.pad(marker.palette[values].astype(np.float64), ((1, 1), (1, 1), (0, 0)))

    def camera(self, rng: np.random.Generator) -> Camera:
        """A camera with a random tilt axis and a random sub-pixel shift."""
        height, width = (int(edge) for edge in (self._shape + 2 * MARGIN) * PIXELS)
        around, (right, down) = rng.random() * 2 * math.pi, rng.random(2)
        x, y, c, s = math.cos(around), math.sin(around), math.cos(TILT), math.sin(TILT)
        pose = np.eye(4)
        pose[:3, :3] = [
            [c + x * x * (1 - c), x * y * (1 - c), y * s],
            [x * y * (1 - c), c + y * y * (1 - c), -x * s],
            [-y * s, x * s, c],
        ]
        pose[2, 3] = distance = DISTANCE * float(self._shape.max())
        focal = PIXELS * distance
        return Camera.pinhole(
            width, height, focal, focal, width / 2 + right - 0.5, height / 2 + down - 0.5, pose
        )

    def gradients(
        self, camera: Camera, rgb: np.ndarray, alpha: np.ndarray, grey: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, float]:
        """Gradients of the loss with respect to the images, the PSNR, and the maximum transmittance."""
        expected, inside = self._target(camera, grey)
        error = rgb - expected
        transmittance = np.maximum(1 - alpha, 1e-7)
        lacking = np.where(inside, np.maximum(OPAQUE + np.log(transmittance), 0), 0)
        by_alpha = -2 * self._leak * lacking / transmittance / alpha.size
        by_images = {
            "rgb": (2 * error / error.size).astype(np.float32),
            "alpha": by_alpha.astype(np.float32),
        }
        psnr = -10 * math.log10(max(float(np.mean(error * error)), 1e-12))
        return by_images, psnr, float(transmittance[inside].max())

    def _target(self, camera: Camera, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colours (h, w, 3) of the printed marker at pixel centres, and the mask (h, w) of its sheet of
        paper."""
        x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
        to_plane = np.linalg.inv(camera.matrix @ camera.world_to_camera[:3, [0, 1, 3]])
        u, v, scale = np.einsum("ij,jyx->iyx", to_plane, np.stack(np.broadcast_arrays(x, y[:, None], 1.0)))
        rows, columns = self._shape
        column = np.clip(np.floor(u / scale + columns / 2).astype(int) + 1, 0, columns + 1)
        row = np.clip(np.floor(v / scale + rows / 2).astype(int) + 1, 0, rows + 1)
        inside = self._inside[row, column]
        return np.where(inside[..., None], self._colors[row, column], grey), inside


class _Parameters:
    """Optimised parameters of the splats, in modules, with the moments of Adam."""

    def __init__(self, quats: np.ndarray, values: dict[str, np.ndarray]) -> None:
        self._quats, self._values = quats, values
        self._first = {name: np.zeros_like(array) for name, array in values.items()}
        self._second = {name: np.zeros_like(array) for name, array in values.items()}

    @classmethod
    def of(cls, marker: Marker) -> _Parameters:
        cloud = marker.gaussians
        assert cloud.colors is not None  # a marker has no harmonics
        opacities = np.clip(cloud.opacities.astype(np.float64), 0.02, 0.9999)
        return cls(
            cloud.quats,
            {
                "positions": cloud.means[:, :2].astype(np.float64) / marker.module,
                "log_scales": np.log(cloud.scales.astype(np.float64) / marker.module),
                "logits": np.minimum(np.log(opacities / (1 - opacities)), MAX_LOGIT),
                "colors": cloud.colors.astype(np.float64),
            },
        )

    def cloud(self, module: float = 1.0) -> SplatCloud:
        """The splats. module: size of a module [m]."""
        values = self._values
        positions = values["positions"] * module
        return SplatCloud(
            np.column_stack([positions, np.zeros(len(positions))]),
            self._quats,
            np.exp(values["log_scales"]) * module,
            self._opacities(),
            colors=values["colors"],
        )

    def _opacities(self) -> np.ndarray:
        return 1 / (1 + np.exp(-self._values["logits"]))

    def step(self, gradients: dict[str, np.ndarray], iteration: int, rate_factor: float) -> None:
        """One step of Adam with scaled learning rates, then clamp to the limits."""
        values, opacities = self._values, self._opacities()
        scales = np.exp(values["log_scales"])
        raw = {
            "positions": gradients["means"][:, :2],
            "log_scales": gradients["scales"] * scales,
            "logits": gradients["opacities"] * opacities * (1 - opacities),
            "colors": gradients["colors"],
        }
        factors = {"positions": np.minimum(scales / SLOW, 1)}
        for name, gradient in raw.items():
            first, second = self._first[name], self._second[name]
            first += (1 - BETA1) * (gradient - first)
            second += (1 - BETA2) * (gradient.astype(np.float64) ** 2 - second)
            size = np.sqrt(second / (1 - BETA2**iteration)) + 1e-12
            rate = rate_factor * RATES[name] * factors.get(name, 1)
            values[name] -= rate * first / (1 - BETA1**iteration) / size
        np.clip(values["log_scales"], math.log(MIN_SCALE), math.log(MAX_SCALE), out=values["log_scales"])
        np.clip(values["logits"], -4, MAX_LOGIT, out=values["logits"])
        np.clip(values["colors"], 0, 1, out=values["colors"])
