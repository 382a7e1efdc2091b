"""Direct image alignment: the camera pose at which a rendered scene matches an image.

Efficient second-order minimisation (Malis 2004) of robust photometric residuals, from coarse to fine. The
Jacobian of a rendered pixel is its image gradient times the motion of its point, which the rendered depth
determines; this takes one render per step (Lucas-Kanade), and central differences take twelve. Gain and
offset of each channel are eliminated, so the result does not depend on exposure and white balance.

The covariance is a cluster-robust sandwich estimate: blocks of pixels are independent, the pixels within a
block may be correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.util.errors import InputError
from fidsplat.vision.pyramid import resized, smoothed

Render = Callable[[Camera], tuple[np.ndarray, np.ndarray]]
"""rgb (h, w, 3) and depth (h, w) of a camera"""

MAX_PIXELS = 20_000
"""maximum number of pixels of a level; those of the largest gradients are used"""
MIN_SIDE = 48
"""minimum side in pixels of the coarsest level"""
MAX_LEVELS = 4
COARSE = 2
"""stages of the coarsest level"""
MIN_BLOCK, BLOCKS = 4, 30
"""independent blocks of the covariance: minimum side in pixels, and number along the shorter side"""
_MEDIAN = {1: 0.4549, 3: 2.3660}
"""median of the sum of squares of so many normal numbers"""
MIN_INLIERS = 0.6
"""share of inliers from which a pose counts as found"""
HUBER, TUKEY = 1.5, 4.685
"""robust thresholds in standard deviations of the noise: coarse levels, finest level"""
MIN_NOISE, MAX_NOISE = 1e-3, 0.03
"""limits of the estimated noise of a pixel, display values; residuals above TUKEY * MAX_NOISE never fit"""
GAINS = 0.05, 20.0
"""limits of the gain of the image relative to the render"""
MIN_INFORMATION = 1e-9
"""smallest eigenvalue of the scaled information matrix of a determined pose"""
_DAMPING = 1e-3
"""initial damping of Levenberg-Marquardt, relative to the diagonal"""
_SETTLED = {"huber": 0.03, "tukey": 0.01}
"""root mean square motion of the pixels below which a level has converged"""


class Stage(NamedTuple):
    """One level of the pyramid with one blur."""

    shrink: int
    blur: float
    """standard deviation in pixels of the level"""
    steps: int
    """maximum number of steps"""


def stages_of(width: int, height: int) -> list[Stage]:
    """Stages from coarse to fine for an image size. The first is blurred more, for a larger basin of
    convergence; the last is not blurred, so that its noise is that of the image."""
    shrinks = [2**k for k in range(MAX_LEVELS) if k == 0 or min(width, height) >> k >= MIN_SIDE]
    coarsest = shrinks[-1]
    middle = [Stage(shrink, 0.7, 5 if shrink > 2 else 3) for shrink in reversed(shrinks[1:-1])]
    return [Stage(coarsest, 2.0, 10), Stage(coarsest, 1.0, 5), *middle, Stage(1, 0.0, 4)]


@dataclass(frozen=True, eq=False)
class Alignment:
    """Result of `align`."""

    camera: Camera
    covariance: np.ndarray
    """(6, 6) of a rotation vector [rad] and a translation [m] applied after `world_to_camera`; infinite if
    the image does not determine the pose"""
    inliers: float
    """share of the textured pixels whose residuals are below the robust threshold; 0 for a blank image"""
    noise: float
    """standard deviation of the residuals of a pixel, display values"""
    gain: np.ndarray
    """(c,) gain of the image relative to the render, by channel"""


@dataclass(frozen=True, eq=False)
class Target:
    """The image at one stage, at its textured pixels."""

    stage: Stage
    camera: Camera
    """size and intrinsics of the stage"""
    rows: np.ndarray
    """(n,) indices of the pixels in the flat image"""
    values: np.ndarray
    """(c, n)"""
    slopes: np.ndarray
    """(2, c, n) derivatives by x and y"""

    @cached_property
    def motions(self) -> tuple[np.ndarray, np.ndarray]:
        """(2, 3, n) derivatives of pixel coordinates x and y by a rotation of the camera axes, and by a
        translation of points at depth 1."""
        camera, rays = self.camera, self.camera.rays(_centres(self.rows, self.camera.width))
        if camera.lens is None:
            by_point = np.zeros((len(rays), 2, 3))
            by_point[:, [0, 1], [0, 1]], by_point[:, :, 2] = 1, -rays[:, :2]
        else:
            by_point = camera.lens.derivative(rays)
        by_point = by_point * np.array([camera.fx, camera.fy])[:, None]
        turning = np.cross(rays[:, None], by_point)  # g . (w x ray) = w . (ray x g)
        by_turn, by_move = (
            np.ascontiguousarray(np.moveaxis(a, 0, 2), np.float32) for a in (turning, by_point)
        )
        return by_turn, by_move

    @cached_property
    def blocks(self) -> np.ndarray:
        """(n,) block numbers of the pixels."""
        width, height = self.camera.width, self.camera.height
        side = max(MIN_BLOCK, min(width, height) // BLOCKS)
        y, x = np.divmod(self.rows, width)
        return np.unique(y // side * width + x // side, return_inverse=True)[1]


def target_of(image: np.ndarray, mask: np.ndarray | None, camera: Camera, stage: Stage) -> Target:
    """The stage's pixels of an image (h, w, c) float32. mask: (h, w) bool, False for ignored pixels."""
    width, height = camera.width // stage.shrink, camera.height // stage.shrink
    small = camera.resampled(width, height)
    values = smoothed(resized(image, width, height), stage.blur)
    inner = np.zeros((height, width), bool)
    inner[1:-1, 1:-1] = True
    ignored = np.zeros((height, width), np.float32) if mask is None else resized(~mask, width, height)
    if camera.lens is not None:  # the border of the field of view does not move with the camera
        rays = small.rays(_centres(np.arange(width * height), width))
        ignored[np.isnan(rays).any(axis=1).reshape(height, width)] = 1
    if ignored.any():
        # pixels whose blur and gradient contain no ignored pixel
        inner &= smoothed(ignored[:, :, None], max(stage.blur, 0.7))[:, :, 0] < 1e-3
    rows = np.flatnonzero(inner)
    if not len(rows):
        raise InputError(
            "localisation must have pixels away from the border and from ignored pixels, got none at "
            f"{width} x {height}; give a larger image or a mask that ignores less"
        )
    if len(rows) > MAX_PIXELS:
        across, down = values[1:-1, 2:] - values[1:-1, :-2], values[2:, 1:-1] - values[:-2, 1:-1]
        energy = np.einsum("hwc,hwc->hw", across, across) + np.einsum("hwc,hwc->hw", down, down)
        energy = energy[inner[1:-1, 1:-1]]
        rows = rows[np.sort(np.argpartition(energy, -MAX_PIXELS)[-MAX_PIXELS:])]
    return Target(stage, small, rows, _at(values, rows), _slopes(values, rows))


class Residuals:
    """Residuals of a target against the render of a camera, with robust weights."""

    def __init__(self, target: Target, camera: Camera, render: Render) -> None:
        self.target, self.camera = target, camera
        rgb, depth = render(target.camera.with_pose(camera.world_to_camera))
        if len(target.values) == 1:
            rgb = rgb.mean(axis=2, keepdims=True)
        image = smoothed(np.ascontiguousarray(rgb), target.stage.blur)
        self.values = _at(image, target.rows)
        self.slopes = _slopes(image, target.rows)
        self.inverse_depth = _nearest(depth, target.rows)
        self.noise = 0.0

    def weigh(self, robust: str, noise: float | None = None, weights: np.ndarray | None = None) -> Residuals:
        """Fit gain and offset, and compute residuals, weights and cost.

        Args:
            robust: "huber" or "tukey".
            noise: standard deviation of a channel; None: from the residuals.
            weights: (n,) weights of the first fit, e.g. of a pose nearby; None: gain and offset of the first
                fit are those between medians and percentiles.
        """
        x, y = self.values, self.target.values
        for _ in range(2):
            if weights is None:
                (low_x, middle_x, high_x), (low_y, middle_y, high_y) = _percentiles(x), _percentiles(y)
                gain = (high_y - low_y) / np.maximum(high_x - low_x, 1e-6)
                dx, dy = x - middle_x[:, None], y - middle_y[:, None]
            else:
                total = max(float(weights.sum()), 1e-6)
                dx, dy = x - (x @ weights / total)[:, None], y - (y @ weights / total)[:, None]
                square = np.maximum((dx * dx) @ weights, 1e-12)
                if robust == "huber":  # misalignment does not attenuate it
                    gain = np.sqrt(np.maximum((dy * dy) @ weights, 1e-12) / square)
                else:
                    gain = np.maximum((dx * dy) @ weights, 1e-12) / square
            self.gain = np.clip(gain, *GAINS).astype(np.float32)[:, None]
            self.residuals = dy / self.gain - dx
            error = np.sqrt((self.residuals**2).mean(axis=0))
            if noise is None:
                self.noise = max(_median_of(error) * (len(x) / _MEDIAN[len(x)]) ** 0.5, MIN_NOISE)
            else:
                self.noise = noise
            if robust == "huber":
                share = error / np.float32(HUBER * self.noise)
                weights = 1 / np.maximum(share, 1)
                cost = np.where(share < 1, share**2 / 2, share - 0.5)
            else:
                share = error / np.float32(TUKEY * min(self.noise, MAX_NOISE))
                inner = np.maximum(1 - share**2, 0)
                weights, cost = inner**2, 1 - inner**3
        self.weights, self.cost, self.share = weights, float(cost.mean()), share
        return self

    @cached_property
    def motions(self) -> tuple[np.ndarray, np.ndarray]:
        """(6, n) derivatives of pixel coordinates x and y of the points by a motion of the camera axes."""
        turning, shifting = self.target.motions
        across, down = np.concatenate([turning, shifting * self.inverse_depth], axis=1)
        return across, down

    def moved_by(self, motion: np.ndarray) -> float:
        """Root mean square displacement of the pixels by a motion (6,) of the camera axes."""
        across, down = self.motions
        squares = (motion.astype(np.float32) @ across) ** 2 + (motion.astype(np.float32) @ down) ** 2
        return float(np.sqrt(squares.mean()))

    def normal_equations(self, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (6, 6) and right side (6,) of the weighted least squares for the pose, without gain and
        offset. slopes: (2, c, n) image gradients of the Jacobian."""
        (across, down), (gx, gy), w = self.motions, slopes, self.weights
        xx, xy, yy = (w * (a * b).sum(axis=0) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
        rx, ry = w * (gx * self.residuals).sum(axis=0), w * (gy * self.residuals).sum(axis=0)
        matrix = (across @ (xx * across + xy * down).T + down @ (xy * across + yy * down).T).astype(float)
        right = -(across @ rx + down @ ry).astype(float)
        for channel, (by_gain, inverse) in enumerate(self._by_gains(across, down, slopes)):
            matrix -= by_gain @ inverse @ by_gain.T
            basis = self._basis(channel) * self.weights
            right -= by_gain @ inverse @ (basis @ self.residuals[channel]).astype(float)
        return matrix, right

    def covariance(self) -> np.ndarray:
        """(6, 6) covariance of the pose: a sandwich estimate from the scores of blocks. Infinite if the
        pixels do not determine the pose."""
        across, down = self.motions
        (gx, gy), w, channels = self.slopes, self.weights, len(self.residuals)
        scores = -(across * (w * (gx * self.residuals).sum(0)) + down * (w * (gy * self.residuals).sum(0)))
        for channel, (by_gain, inverse) in enumerate(self._by_gains(across, down, self.slopes)):
            basis = self._basis(channel) * (self.weights * self.residuals[channel])
            scores = scores - (by_gain @ inverse).astype(np.float32) @ basis
        blocks = self.target.blocks
        sums = np.array([np.bincount(blocks, weights=row) for row in scores])
        count = sums.shape[1]
        # the derivative of the weighted residual, averaged over directions among the channels
        inner, weights = np.maximum(1 - self.share**2, 0), self.weights
        self.weights = np.maximum(inner**2 - 4 * self.share**2 * inner / channels, 0).astype(np.float32)
        matrix = self.normal_equations(self.slopes)[0]
        self.weights = weights
        deviations = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        scaled = matrix / np.outer(deviations, deviations)
        if np.linalg.matrix_rank(scaled, MIN_INFORMATION, hermitian=True) < 6:
            return np.diag(np.full(6, np.inf))
        inverse = np.linalg.inv(scaled) / np.outer(deviations, deviations)
        return inverse @ (sums @ sums.T) @ inverse * count / max(count - 6 - 2 * channels, 1)

    def _basis(self, channel: int) -> np.ndarray:
        """(2, n) derivatives of the model by gain and offset of a channel."""
        return np.stack([self.values[channel], np.ones_like(self.weights)])

    def _by_gains(
        self, across: np.ndarray, down: np.ndarray, slopes: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """For each channel the blocks of the normal equations that eliminate gain and offset: the mixed block
        (6, 2) of pose and (gain, offset), and the inverse (2, 2) of the block of (gain, offset)."""
        gx, gy = slopes
        for channel in range(len(gx)):
            basis = self._basis(channel)
            weighted = basis * self.weights
            mixed = -(across @ (weighted * gx[channel]).T + down @ (weighted * gy[channel]).T)
            own = (weighted @ basis.T).astype(float)
            yield mixed.astype(float), np.linalg.inv(own + 1e-9 * (1 + np.trace(own)) * np.eye(2))


def align(
    image: np.ndarray, mask: np.ndarray | None, start: Camera, render: Render, coarse: bool = False
) -> Alignment:
    """Align a render of the scene with an image.

    Args:
        image: (h, w, 3) or (h, w, 1) float32 display values.
        mask: (h, w) bool, False for ignored pixels.
        start: camera of the image at its assumed pose.
        render: renders the scene.
        coarse: the stages of the coarsest level only, without a covariance.
    """
    camera, stages = start, stages_of(start.width, start.height)
    residuals = None
    for stage in stages[:COARSE] if coarse else stages:
        residuals = Residuals(target_of(image, mask, start, stage), camera, render).weigh("huber")
        residuals = _minimise(residuals, render, "huber", stage.steps)
        camera = residuals.camera
    assert residuals is not None
    if coarse:
        return Alignment(camera, np.full((6, 6), np.nan), 0.0, residuals.noise, residuals.gain)
    residuals = _minimise(residuals.weigh("tukey"), render, "tukey", stages[-1].steps)
    # an image without the scene's contrast fits a render whose contrast the smallest gain removes
    contrast = bool((residuals.gain > GAINS[0]).any())
    inliers = float((residuals.share < 1).mean()) if contrast else 0.0
    return Alignment(residuals.camera, residuals.covariance(), inliers, residuals.noise, residuals.gain)


def _minimise(found: Residuals, render: Render, robust: str, steps: int) -> Residuals:
    """Levenberg-Marquardt at one stage."""
    damping = _DAMPING
    for _ in range(steps):
        slopes = found.slopes
        if robust == "huber":
            slopes = (slopes + found.target.slopes / found.gain) / 2
        matrix, right = found.normal_equations(slopes)
        diagonal = np.diag(matrix) + 1e-9 * max(float(np.trace(matrix)), 1e-9)
        motion = np.linalg.solve(matrix + damping * np.diag(diagonal), right)
        tried = Residuals(found.target, offset_camera(found.camera, motion), render)
        tried.weigh(robust, found.noise, found.weights)
        if tried.cost <= found.cost:
            noise = min(found.noise, tried.weigh(robust, None, tried.weights).noise)
            found = tried.weigh(robust, noise, tried.weights)
            damping = max(damping / 10, 1e-6)
        else:
            damping *= 10
        if found.moved_by(motion) < _SETTLED[robust]:
            break
    return found


def _centres(rows: np.ndarray, width: int) -> np.ndarray:
    """(n, 2) coordinates x and y of the centres of pixels of the flat image."""
    return np.stack([rows % width, rows // width], axis=1) + 0.5


def _at(image: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(c, n) values of an image (h, w, c) at some pixels."""
    return np.ascontiguousarray(image.reshape(-1, image.shape[2]).take(rows, axis=0).T)


def _slopes(image: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(2, c, n) central differences by x and y of an image (h, w, c) at pixels that are not on its border."""
    width = image.shape[1]
    differences = [_at(image, rows + step) - _at(image, rows - step) for step in (1, width)]
    return np.stack(differences) / 2


def _nearest(depth: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(n,) inverse depths, the largest of a pixel and its neighbours: at an edge the gradient is that of the
    surface in front. 0 for the background."""
    flat, width = depth.reshape(-1), depth.shape[1]
    inverse = np.zeros_like(flat)
    np.divide(1, flat, out=inverse, where=flat > 0)
    near = inverse[rows]
    for shift in (-1, 1, -width, width):
        near = np.maximum(near, inverse[rows + shift])
    return near


def _percentiles(values: np.ndarray) -> np.ndarray:
    """16th, 50th and 84th percentiles of rows (c, n), as (3, c)."""
    at = [int(share * (values.shape[1] - 1)) for share in (0.16, 0.5, 0.84)]
    return np.partition(values, at, axis=1)[:, at].T


def _median_of(values: np.ndarray) -> float:
    """Median without a sort of all values; 0 for none."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2]) if len(values) else 0.0
