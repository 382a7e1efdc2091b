"""refine(): the Gaussians of a whole marker by gradient, opaque and in its colours.

Templates know one rectangle each; here every splat of a marker is free to move in its plane, to stretch, and
to take any colour. Pictures of the marker are drawn as renderers draw its file, by the depth of centres, each
time tilted a little about another axis, so that another order of the splats holds, shifted by parts of a
pixel and over another grey. They are compared with the print itself, and light that comes through costs.
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
from fidsplat.markers import Marker
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.arguments import as_float, callback, instance, invalid, whole_number
from fidsplat.util.errors import InputError

ITERATIONS = 1000
PIXELS = 12
"""of a module; pictures are shifted, so that no line hides between them"""
MARGIN = 1
"""modules around the sheet, where nothing may be seen"""
TILT = math.radians(3)
"""turns the order of centres, and next to nothing else"""
DISTANCE = 100.0
"""edges of the sheet: no perspective"""
QUALITY = Quality(order="centre", lowpass="none", alpha_cutoff=1 / 255, transmittance_stop=1e-6)
OPAQUE = 8.0
"""optical depth that costs nothing any more, a transmittance of 3e-4"""
LEAK = 0.05
"""what a square of missing optical depth costs, in squares of a colour"""
RATES = {"place": 0.003, "log_scales": 0.01, "logits": 0.1, "colors": 0.01}
"""Adam's, in modules, powers of e, logits and colours"""
BETA1, BETA2 = 0.9, 0.99
THINNEST, WIDEST = 0.008, 3.0
"""modules"""
SLOW = 0.15
"""modules: narrower splats move slower, as their width"""
MOST_LOGIT = 7.0


class RefineStep(NamedTuple):
    """What one iteration saw."""

    iteration: int
    """1 for the first"""
    psnr: float
    """dB, of points of the sheet and a module around it, in the order of that iteration"""
    transmittance: float
    """largest on the sheet"""


def refine(
    made: Marker,
    renderer: Renderer | None = None,
    iterations: int = ITERATIONS,
    leak: float = LEAK,
    seed: int = 0,
    progress: Callable[[RefineStep], Any] | None = None,
) -> Marker:
    """A marker whose Gaussians (`Marker.gaussians`) are optimised as a whole: its ``mixture`` is "refined".

    As many splats as before: `template=121` is the one to begin with. The same bits on every run of a device.

    Args:
        made: what `fs.marker` made, but no drawing with slanted edges.
        renderer: opens the device; None: the default device.
        iterations: pictures that are looked at, 1 to 100,000.
        leak: what light that comes through costs, 0 to 1: a square of missing optical depth in squares of a
            colour. Few splats cannot be both opaque and sharp: for the 25 a rectangle of the default template
            take 0.001.
        seed: of the tilts, shifts and greys.
        progress: called after each iteration.

    Raises:
        DeviceError: the device has no gradients.
        InputError: a drawing, a number out of its range, or Gaussians that are more than the marker's
            ``max_splats``.
    """
    start = time.perf_counter()
    instance("made", made, Marker, "what fs.marker returns")
    if renderer is not None and not hasattr(renderer, "backend"):
        raise invalid("renderer", "an fs.Renderer or None", renderer)
    callback("progress", progress)
    iterations = whole_number("iterations", iterations, 1, 100_000)
    if not 0 <= as_float(leak) <= 1:
        raise InputError(f"leak is {leak!r}; it must lie from 0 to 1")
    seed = whole_number("the seed", seed, 0, 2**63 - 1)
    if made.regions is not None:
        raise InputError(f"{made.spec} has edges across its modules; only markers of modules are refined")
    renderer = Renderer() if renderer is None else renderer
    sheet = _Sheet(made, float(leak))
    splats = _Free.of(made)
    rng = np.random.default_rng(seed)
    for iteration in range(1, iterations + 1):
        camera, grey = sheet.camera(rng), np.full(3, rng.random())
        capture = Capture(camera, outputs=("rgb", "alpha"), quality=QUALITY, background=tuple(grey))
        frame = renderer.render_differentiable(splats.cloud(), capture)
        slopes, psnr, through = sheet.slopes(camera, frame["rgb"], frame["alpha"], grey)
        splats.step(frame.backward(slopes), iteration, _share(iteration / iterations))
        if progress is not None:
            progress(RefineStep(iteration, psnr, through))
    return replace(
        made,
        mixture="refined",
        cloud=splats.cloud(made.module).with_coplanar_groups(0),
        seconds=made.seconds + time.perf_counter() - start,
    )


def _share(done: float) -> float:
    """Of the learning rates: all of them for the first half, then along a cosine to 3 %."""
    return 1.0 if done < 0.5 else 0.03 + 0.485 * (1 + math.cos(math.pi * (2 * done - 1)))


class _Sheet:
    """The print, in modules about its middle."""

    def __init__(self, made: Marker, leak: float) -> None:
        self._leak, self._shape = leak, np.array(made.grid.shape)
        self._colors = np.pad(made.palette[made.grid].astype(np.float64), ((1, 1), (1, 1), (0, 0)))
        self._inside = np.pad(np.ones(made.grid.shape, bool), 1)

    def camera(self, rng: np.random.Generator) -> Camera:
        """Tilted about some axis of the plane, and shifted by less than a pixel."""
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

    def slopes(
        self, camera: Camera, rgb: np.ndarray, alpha: np.ndarray, grey: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, float]:
        """Derivatives of the loss by a picture, the picture's PSNR, and the largest transmittance inside."""
        wanted, inside = self._seen(camera, grey)
        off = rgb - wanted
        left = np.maximum(1 - alpha, 1e-7)
        lacking = np.where(inside, np.maximum(OPAQUE + np.log(left), 0), 0)
        by_alpha = -2 * self._leak * lacking / left / alpha.size
        slopes = {
            "rgb": (2 * off / off.size).astype(np.float32),
            "alpha": by_alpha.astype(np.float32),
        }
        psnr = -10 * math.log10(max(float(np.mean(off * off)), 1e-12))
        return slopes, psnr, float(left[inside].max())

    def _seen(self, camera: Camera, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The print at each pixel's middle, (h, w, 3), and (h, w) where it is hit."""
        x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
        to_plane = np.linalg.inv(camera.matrix @ camera.world_to_camera[:3, [0, 1, 3]])
        u, v, scale = np.einsum("ij,jyx->iyx", to_plane, np.stack(np.broadcast_arrays(x, y[:, None], 1.0)))
        rows, columns = self._shape
        column = np.clip(np.floor(u / scale + columns / 2).astype(int) + 1, 0, columns + 1)
        row = np.clip(np.floor(v / scale + rows / 2).astype(int) + 1, 0, rows + 1)
        inside = self._inside[row, column]
        return np.where(inside[..., None], self._colors[row, column], grey), inside


class _Free:
    """The splats' free values in modules, with Adam's means of their gradients."""

    def __init__(self, quats: np.ndarray, values: dict[str, np.ndarray]) -> None:
        self._quats, self._values = quats, values
        self._first = {name: np.zeros_like(array) for name, array in values.items()}
        self._second = {name: np.zeros_like(array) for name, array in values.items()}

    @classmethod
    def of(cls, made: Marker) -> _Free:
        cloud = made.gaussians
        assert cloud.colors is not None  # a marker has no harmonics
        opacities = np.clip(cloud.opacities.astype(np.float64), 0.02, 0.9999)
        return cls(
            cloud.quats,
            {
                "place": cloud.means[:, :2].astype(np.float64) / made.module,
                "log_scales": np.log(cloud.scales.astype(np.float64) / made.module),
                "logits": np.minimum(np.log(opacities / (1 - opacities)), MOST_LOGIT),
                "colors": cloud.colors.astype(np.float64),
            },
        )

    def cloud(self, module: float = 1.0) -> SplatCloud:
        """The splats, a module being so many metres."""
        values = self._values
        place = values["place"] * module
        return SplatCloud(
            np.column_stack([place, np.zeros(len(place))]),
            self._quats,
            np.exp(values["log_scales"]) * module,
            self._opacities(),
            colors=values["colors"],
        )

    def _opacities(self) -> np.ndarray:
        return 1 / (1 + np.exp(-self._values["logits"]))

    def step(self, gradients: dict[str, np.ndarray], iteration: int, share: float) -> None:
        """One step of Adam, and back within the limits."""
        values, opacities = self._values, self._opacities()
        scales = np.exp(values["log_scales"])
        inner = {
            "place": gradients["means"][:, :2],
            "log_scales": gradients["scales"] * scales,
            "logits": gradients["opacities"] * opacities * (1 - opacities),
            "colors": gradients["colors"],
        }
        slow = {"place": np.minimum(scales / SLOW, 1)}
        for name, gradient in inner.items():
            first, second = self._first[name], self._second[name]
            first += (1 - BETA1) * (gradient - first)
            second += (1 - BETA2) * (gradient.astype(np.float64) ** 2 - second)
            size = np.sqrt(second / (1 - BETA2**iteration)) + 1e-12
            values[name] -= share * RATES[name] * slow.get(name, 1) * first / (1 - BETA1**iteration) / size
        np.clip(values["log_scales"], math.log(THINNEST), math.log(WIDEST), out=values["log_scales"])
        np.clip(values["logits"], -4, MOST_LOGIT, out=values["logits"])
        np.clip(values["colors"], 0, 1, out=values["colors"])
