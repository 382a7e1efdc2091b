"""Interface of direct image alignment: sums over pixels for the normal equations of a camera pose."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fidsplat.backends.prepare import prepare
from fidsplat.cameras import Camera
from fidsplat.cameras.pose_offset import offset_pose
from fidsplat.capture.capture import Capture
from fidsplat.util.errors import InputError

BINS, SHIFT, FIRST_BIN = 256, 19, 113 << 4
"""bins of the histograms of gradient magnitudes and residuals, positive float32: 16 per octave from 2^-14 to
4, bin = (bits >> SHIFT) - FIRST_BIN"""


class CoarseToFineStage(NamedTuple):
    """Stage of coarse-to-fine alignment: a level of the image pyramid, and a blur filter for it."""

    camera: Camera
    """size, intrinsics and lens of the level"""
    ignored: np.ndarray | None
    """(h, w) bool, True for ignored pixels of the level; None: none"""
    taps: np.ndarray
    """(r + 1,) float32: blur weights of the offsets 0 to r, the same on both sides; (1,) without blur"""
    block_size: int
    """side in pixels of the square blocks for which `AlignmentSums.block_rhs` has separate sums"""


class AlignmentFit(NamedTuple):
    """Robust loss, and exposure of the image: image = gain * rendered value + offset, for each of c
    channels."""

    gain: np.ndarray
    """(c,)"""
    offset: np.ndarray
    """(c,)"""
    huber: bool
    """True: Huber's loss, with the mean of the gradients of rendered frame and image; False: Tukey's loss,
    with the gradients of the frame"""
    noise: float = 0.0
    """standard deviation of the residuals at the previous pose; 0: not known, and estimated from
    the median of the residuals"""


class Estimate(NamedTuple):
    """Estimate of pose and exposure."""

    pose: np.ndarray
    """(4, 4) world_to_camera"""
    fit: AlignmentFit
    noise: float = 0.0
    """standard deviation of the residuals of a channel; 0: the exposure is unknown"""


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A scene that is rendered for alignment."""

    backend: Any
    """the Backend that renders it"""
    splats: Any
    """the cloud, for `prepare`"""
    cloud: Any
    """the cloud on the device"""
    capture: Capture
    """with the outputs rgb and depth"""
    render_capture: Callable[[Capture], Any]

    def render(self, camera: Camera) -> Any:
        """Frame with rgb and depth of a camera."""
        return self.render_capture(self.capture.with_(camera=camera))

    def prepared(self, camera: Camera) -> tuple[Any, Any, np.ndarray]:
        """Pipeline, view and origin (3,) of the frame of a camera."""
        features, view = prepare(self.splats, self.capture.with_(camera=camera))
        return self.backend.pipeline(features, self.backend.frame_config(view)), view, self.splats.origin


class PerturbedFrame(NamedTuple):
    """Frame of the same scene after a small camera motion, for derivatives by finite differences."""

    frame: Any
    size: float
    """size of the motion [rad or m]"""
    axis: int
    """component of the motion: 0 for x, 1 for y, 2 for z. Without a lens, a pixel has the ray (x, y, 1), and
    the derivative with respect to the motion along (or about) z is -x d_x - y d_y, with d_x and d_y the
    derivatives with respect to the motions along (or about) x and y"""


@dataclass(frozen=True, eq=False)
class AlignmentSums:
    """Weighted sums over the textured pixels of c channels, for the normal equations.

    The model of a residual (image minus rendered value) is J m + a x + b: m (6,) is the motion of the camera,
    J (6,) the derivative of the residual with respect to it, x the rendered value, a and b the changes of
    gain and offset. A row (8,) of the design matrix is (J, x, 1).
    """

    matrix: np.ndarray
    """(c, 8, 8) outer product of a row with itself, weighted by the second derivative of the loss"""
    rhs: np.ndarray
    """(c, 8, 1) row times residual. With a PerturbedFrame (c, 8, 2): row times d, and row times -r d, with d
    the derivative of the rendered value with respect to the motion, and r the component of the ray with the
    index `PerturbedFrame.axis`"""
    squared_residuals: np.ndarray
    """(c,)"""
    block_rhs: np.ndarray
    """(blocks, c, 8) row times residual in each block; empty unless requested"""
    block_matrices: np.ndarray
    """(blocks, c, 8, 8) `matrix` of each block; empty unless requested"""
    block_moments: np.ndarray
    """(blocks, c, 6) unweighted sums of each block: p, r, p^2, r^2, p r and 1, with p the image without gain
    and offset, and r the rendered value; empty unless requested"""
    cost: float
    """mean loss"""
    cost_before: float
    """mean loss with the noise of the previous pose (`AlignmentFit.noise`), for comparison with the `cost` of
    the previous pose"""
    inverse_depth: float
    """mean squared inverse depth [1 / m^2]"""
    noise: float
    """standard deviation of the residuals of a channel"""


class Score(NamedTuple):
    """Sums at a pose, and finite differences of the score, which is the gradient of the loss with respect to
    the pose."""

    sums: AlignmentSums
    derivatives: dict[int, np.ndarray]
    """`AlignmentSums.rhs` of the perturbed frames, by the axis of the motion: 0 to 2 rotations, 3 to 5
    translations"""


HUBER, TUKEY = 1.5, 4.685
"""robust thresholds in standard deviations of the noise"""
MIN_NOISE, MAX_NOISE = 1e-2, 0.03
"""limits of the noise, display values; residuals above TUKEY * MAX_NOISE never fit"""
DAMPING = 1e-3
"""initial damping of Levenberg-Marquardt, relative to the diagonal"""
DIFFERENCE = 0.01
"""motion in pixels of the finite differences"""
STEP = -1
"""value instead of an axis: the next pose is that of a step of Levenberg-Marquardt (alignment_step.cl)"""
MIN_GAIN, MAX_GAIN = 0.05, 20.0
"""limits of the gain of the image relative to the render"""
_MEDIAN = {1: 0.4549, 3: 2.3660}
"""median of the chi-squared distribution, by degrees of freedom"""


def noise_factor(channels: int) -> float:
    """Factor from the median over pixels of the residuals' RMS over channels to their standard deviation."""
    return (channels / _MEDIAN[channels]) ** 0.5


class AlignmentKernels(ABC):
    """Kernels for the residuals between an image and rendered frames, and for sums over these residuals."""

    _stages: list[CoarseToFineStage]
    _scene: RenderedScene

    def __init__(self) -> None:
        self.lock = threading.RLock()
        """held from `load` to the last `sums` of an image"""

    @abstractmethod
    def load(
        self, image: np.ndarray, stages: list[CoarseToFineStage], max_pixels: int, scene: RenderedScene
    ) -> None:
        """Prepare an image (h, w, 1 or 3), uint8 or float32 display values, for all stages of alignment, from
        coarse to fine, and a scene. A stage uses about `max_pixels` pixels, those with the largest
        gradients."""

    @property
    @abstractmethod
    def pixels(self) -> list[int]:
        """Number of used pixels of each stage; waits for the device."""

    @property
    @abstractmethod
    def noise(self) -> float:
        """Standard deviation of the noise of the image at the last stage (`noise_of`), along every eighth
        row; waits for the device."""

    def check_pixels(self) -> None:
        """Raise InputError if a stage uses no pixel; waits for the device."""
        for stage, pixels in zip(self._stages, self.pixels, strict=True):
            if not pixels:
                raise InputError(
                    "localisation must have pixels away from the border and from ignored pixels, got none at "
                    f"{stage.camera.width} x {stage.camera.height}; give a larger image or a mask that "
                    "ignores less"
                )

    def release_scene(self) -> None:
        """Release the cloud of `load`, after the last `sums`."""
        del self._scene

    def frame(self, stage: int, pose: np.ndarray) -> Any:
        """Frame of the scene at a pose."""
        return self._scene.render(self._stages[stage].camera.with_pose(pose))

    @abstractmethod
    def sums(
        self,
        stage: int,
        frame: Any,
        fit: AlignmentFit,
        perturbed: PerturbedFrame | None = None,
        blocks: bool = False,
    ) -> AlignmentSums:
        """Sums of a stage for a frame. blocks: whether to sum each block too."""

    def block_sums(self, stage: int, at: Estimate) -> AlignmentSums:
        """Sums of each block at a pose."""
        return self.sums(stage, self.frame(stage, at.pose), at.fit, blocks=True)

    def score(self, stage: int, at: Estimate) -> Score:
        """Score at a pose, with derivatives by finite differences of frames."""
        frame, derivatives = self.frame(stage, at.pose), {}
        sums = self.sums(stage, frame, at.fit, blocks=True)
        for axis in self.axes(stage):
            motion, size = np.zeros(6), self.motion_size(stage, axis, sums)
            motion[axis] = size
            perturbed = PerturbedFrame(self.frame(stage, offset_pose(at.pose, motion)), size, axis % 3)
            fit = at.fit._replace(noise=sums.noise)
            derivatives[axis] = self.sums(stage, frame, fit, perturbed=perturbed).rhs
        return Score(sums, derivatives)

    def axes(self, stage: int) -> tuple[int, ...]:
        """Axes of the motions of `score`. A translation along the ray of a pixel or a rotation about it does
        not change the pixel. Without a lens, the derivatives with respect to z therefore follow from the
        derivatives with respect to x and y."""
        return (0, 1, 3, 4) if self._stages[stage].camera.lens is None else tuple(range(6))

    def motion_size(self, stage: int, axis: int, sums: AlignmentSums) -> float:
        """Size of a motion of `score` [rad or m]."""
        camera = self._stages[stage].camera
        angle = DIFFERENCE / max(camera.fx, camera.fy)
        return angle if axis < 3 else angle / max(sums.inverse_depth**0.5, 1e-3)

    def minimise(
        self, at: Estimate, steps: Sequence[tuple[int, int]], last: int | None, tolerance: float
    ) -> tuple[Estimate, Score | None] | None:
        """Minimise Huber's loss by Levenberg-Marquardt on the device, without waiting between the frames;
        None on devices without it.

        at: start.
        steps: stages, with their maximum numbers of steps.
        last: stage of the score of Tukey's loss that is computed afterwards; None: no score.
        tolerance: motion in pixels below which a stage has converged.
        """
        return None


def bins_of(values: np.ndarray) -> np.ndarray:
    """Histogram bins, 1 to 255, of positive values. Bin 0 is for unused pixels."""
    upper = np.ascontiguousarray(values, np.float32).view(np.uint32) >> SHIFT
    return np.clip(upper.astype(np.int64) - FIRST_BIN, 1, BINS - 1)


def lowest_bin(counts: np.ndarray, max_pixels: int) -> int:
    """Lowest bin to use, so that it and the higher bins contain about `max_pixels` values of a histogram."""
    at_least = np.cumsum(counts[:0:-1])[::-1]
    return 1 + int(np.flatnonzero(at_least >= min(max_pixels, at_least[0]))[-1])


def noise_of(median: float) -> float:
    """Standard deviation of the noise of an image, from the median of |v - (left + right) / 2| over its
    values v: half of the absolute second differences along a row."""
    return median / (0.6745 * 1.5**0.5)
