"""Interface of direct image alignment: sums over pixels for the normal equations of a camera pose."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from fidsplat.cameras import Camera

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


class RenderedScene(Protocol):
    """A scene on a device."""

    @property
    def key(self) -> tuple[Any, Any]:
        """Resident cloud and capture: the key under which command lists of frames are cached."""
        ...

    def render(self, camera: Camera) -> Any:
        """Frame with rgb and depth of a camera."""
        ...

    def prepared(self, camera: Camera) -> tuple[Any, Any, Any, np.ndarray]:
        """Pipeline, resident cloud, view and origin (3,) of the frame of a camera."""
        ...


class PerturbedFrame(NamedTuple):
    """Frame of the same scene after a small camera motion, for derivatives by finite differences."""

    frame: Any
    size: float
    """size of the motion [rad or m]"""
    axis: int
    """index (0 or 1) of a component r of the ray: with d the derivative with respect to this motion, the
    derivative with respect to the motion along (or about) z is -r d"""


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


HUBER, TUKEY = 1.5, 4.685
"""robust thresholds in standard deviations of the noise"""
MIN_NOISE, MAX_NOISE = 1e-2, 0.03
"""limits of the noise, display values; residuals above TUKEY * MAX_NOISE never fit"""
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
    ) -> list[int]:
        """Prepare an image (h, w, 1 or 3), float32 display values, for all stages of alignment and a
        scene; returns the number of pixels of each. A stage uses about `max_pixels` pixels, those with the
        largest gradients."""

    def release_scene(self) -> None:
        """Release the cloud of `load`, after the last `sums`."""
        del self._scene

    def frame(self, stage: int, pose: np.ndarray, perturbed: bool = False) -> Any:
        """Frame of the scene at a pose, valid until the next frame with this value of `perturbed`."""
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

    def derivatives(
        self, stage: int, frame: Any, fit: AlignmentFit, motions: Sequence[tuple[np.ndarray, float, int]]
    ) -> list[np.ndarray]:
        """`AlignmentSums.rhs` of each motion. motions: pose after the motion, and size and axis as in
        PerturbedFrame."""
        frames = (PerturbedFrame(self.frame(stage, pose, True), size, axis) for pose, size, axis in motions)
        return [self.sums(stage, frame, fit, perturbed=perturbed).rhs for perturbed in frames]

    def minimise(
        self, stage: int, at: Estimate, steps: int, tolerance: float, damping: float
    ) -> Estimate | None:
        """Minimise Huber's loss by at most `steps` iterations of Levenberg-Marquardt on the device; None on
        devices without it.

        at: start.
        tolerance: motion in pixels below which the stage has converged.
        damping: initial damping, relative to the diagonal.
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
