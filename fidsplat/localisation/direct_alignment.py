"""Direct image alignment: estimates the camera pose at which a rendered scene matches an image.

Efficient second-order minimisation (Malis 2004) of robust photometric residuals, from coarse to fine. The
Jacobian of a rendered pixel is its image gradient times the motion of its point, which the rendered depth
determines; this takes one render per step (Lucas-Kanade). Gain and offset of each channel are unknowns too,
so the result does not depend on exposure and white balance.

The last steps and the covariance follow an M-estimator (Huber 1967): the sandwich of the derivative of
the score, by finite differences of renders, and of the covariance of the score. Blocks of pixels are
independent, the pixels within a block may be correlated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from fidsplat.backends.alignment import (
    DAMPING,
    MAX_GAIN,
    MIN_GAIN,
    MIN_NOISE,
    AlignmentFit,
    AlignmentKernels,
    AlignmentSums,
    CoarseToFineStage,
    Estimate,
    RenderedScene,
    Score,
)
from fidsplat.cameras import Camera
from fidsplat.cameras.pose_offset import offset_pose
from fidsplat.localisation.normal_equations import kernels_for
from fidsplat.vision.pyramid import resized, smoothed, taps_of

MAX_PIXELS = 20_000
"""maximum number of pixels of a level; pixels with the largest gradients are used"""
MAX_SIDE = 320
"""maximum side in pixels of the finest level, by default: about 3 times the error of 640 pixels in half the
time"""
MIN_SIDE = 48
"""minimum side in pixels of the coarsest level"""
MAX_LEVELS = 4
COARSE = 2
"""stages of the coarsest level"""
MIN_BLOCK, BLOCKS = 6, 15
"""independent blocks of the covariance: minimum side in pixels, and number along the shorter side"""
MIN_INLIERS = 0.6
"""fraction of matching blocks from which a pose counts as found"""
MIN_CORRELATION, MIN_CONTRAST, MIN_PIXELS = 0.7, 0.02, 12
"""normalised correlation of a matching block; minimum contrast and textured pixels of a block that counts"""
MIN_BLOCKS = 24
"""minimum denominator of the fraction of matching blocks: twice the number of unknowns"""
MIN_IMAGE_NOISE = 0.005
"""minimum noise of an image, display values"""
_QUARTILE = 1.1
"""third quartile of the reduced chi-squared of blocks with noise alone"""
MIN_INFORMATION = 1e-9
"""smallest eigenvalue of the scaled information matrix of a determined pose"""
_SETTLED = 0.3
"""motion in pixels of a step that ends a stage"""
_REPEATED, _REPEATED_PIXELS = 4.0, 0.01
"""size of a last step above which another step follows: in standard deviations, and in pixels for an image
without noise"""
_INCREASE = 1.01
"""largest relative loss after a last step; the zero of the score is not exactly the minimum of the loss"""
_LAST_STEPS = 6
"""maximum number of last steps"""
_FULL_STEPS, _FULL_SETTLED = 12, 0.01
"""maximum number of steps with Huber's loss at full size, and motion in pixels that ends them"""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Result of `align`."""

    camera: Camera
    covariance: np.ndarray
    """(6, 6) of a rotation vector [rad] and a translation [m] applied after `world_to_camera`; infinite if
    the image does not determine the pose"""
    inliers: float
    """fraction of the textured blocks that match the render; 0 for a blank image"""
    noise: float
    """standard deviation of the residuals of a pixel, display values"""
    gain: np.ndarray
    """(c,) gain of the image relative to the render, by channel"""


def stages_of(camera: Camera, mask: np.ndarray | None = None) -> list[tuple[CoarseToFineStage, int]]:
    """Stages from coarse to fine for a camera, with maximum numbers of steps of `_minimise`. The first is
    blurred more, for a larger basin of convergence; the last is not blurred, so that it has the noise of the
    image."""
    if mask is None and camera.lens is None:
        return _plain_stages(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return _stages(camera, _ignored(mask, camera))


@lru_cache(maxsize=8)
def _plain_stages(*intrinsics: Any) -> list[tuple[CoarseToFineStage, int]]:
    return _stages(Camera.pinhole(*intrinsics), None)


def _stages(camera: Camera, ignored: np.ndarray | None) -> list[tuple[CoarseToFineStage, int]]:
    short = min(camera.width, camera.height)
    shrinks = [2**k for k in range(MAX_LEVELS) if k == 0 or short >> k >= MIN_SIDE]
    coarsest = shrinks[-1]
    finer = [(shrink, 0.7, 8 if shrink > 2 else 5) for shrink in reversed(shrinks[:-1] or [1])]
    stages = []
    for shrink, blur, steps in [(coarsest, 2.0, 10), (coarsest, 1.0, 6), *finer, (1, 0.0, 0)]:
        width, height = camera.width // shrink, camera.height // shrink
        side = max(MIN_BLOCK, min(width, height) // BLOCKS)
        hidden = None
        if ignored is not None:  # pixels whose blur or gradient contains an ignored pixel
            fractions = smoothed(resized(ignored, width, height)[:, :, None], max(blur, 0.7))
            hidden = fractions[:, :, 0] > 1e-3
        stage = CoarseToFineStage(camera.resampled(width, height), hidden, taps_of(blur), side)
        stages.append((stage, steps))
    return stages


def align(
    image: np.ndarray,
    mask: np.ndarray | None,
    start: Camera,
    scene: RenderedScene,
    coarse: bool = False,
    max_side: int = MAX_SIDE,
) -> Alignment:
    """Align a render of the scene with an image.

    Args:
        image: (h, w, 3) or (h, w, 1), uint8 or float32 display values.
        mask: (h, w) bool, False for ignored pixels.
        start: camera of the image at its assumed pose.
        scene: the scene.
        coarse: the stages of the coarsest level only, without a covariance.
        max_side: maximum side in pixels of the finest level.
    """
    shrink = max(1.0, max(start.width, start.height) / max_side)
    finest = start.resampled(max(1, round(start.width / shrink)), max(1, round(start.height / shrink)))
    stages = stages_of(finest, mask)[: COARSE if coarse else None]
    kernels, channels = kernels_for(scene), image.shape[2]
    at = Estimate(start.world_to_camera, AlignmentFit(np.ones(channels), np.zeros(channels), huber=True))
    with kernels.lock:
        kernels.load(image, [stage for stage, _ in stages], MAX_PIXELS, scene)
        try:
            all_stages = [_Stage(number, stage.camera, kernels) for number, (stage, _) in enumerate(stages)]
            limits = [(stage, steps) for stage, (_, steps) in zip(all_stages, stages, strict=True) if steps]
            at, score = _minimise(at, limits, None if coarse else all_stages[-1])
            if score is None:
                fit = at.fit
                found = Alignment(start.with_pose(at.pose), np.full((6, 6), np.nan), 0.0, at.noise, fit.gain)
            else:
                found = _finish(at, score, all_stages[-1], start)
        finally:
            kernels.release_scene()
    return found


def _moved(at: Estimate, sums: AlignmentSums, step: np.ndarray) -> Estimate:
    """The estimate after a step (6 + 2 c,) of pose and exposure."""
    gains, offsets = _exposure_of(sums) if at.fit.huber else (1 + step[6::2], step[7::2])
    fit = at.fit._replace(
        gain=np.clip(at.fit.gain * gains, MIN_GAIN, MAX_GAIN), offset=at.fit.offset + at.fit.gain * offsets
    )
    return Estimate(offset_pose(at.pose, step[:6]), fit, sums.noise)


@dataclass(frozen=True, eq=False)
class _Stage:
    number: int
    camera: Camera
    kernels: AlignmentKernels

    def sums(self, frame: Any, at: Estimate, noise: float = 0.0) -> AlignmentSums:
        """Sums over the pixels of the stage."""
        return self.kernels.sums(self.number, frame, at.fit._replace(noise=noise))

    def pixels(self, motion: np.ndarray, sums: AlignmentSums) -> float:
        """Approximate displacement of pixels by a motion (6,) of the camera."""
        turn, shift = motion[:3] @ motion[:3], motion[3:] @ motion[3:]
        return max(self.camera.fx, self.camera.fy) * math.sqrt(turn + shift * sums.inverse_depth)


def _minimise(
    at: Estimate, stages: list[tuple[_Stage, int]], last: _Stage | None, settled: float = _SETTLED
) -> tuple[Estimate, Score | None]:
    """Levenberg-Marquardt at some stages, with maximum numbers of steps; returns the estimate and its score
    at the stage `last`, if there is one."""
    kernels = stages[0][0].kernels
    limits, number = [(stage.number, steps) for stage, steps in stages], None if last is None else last.number
    found = kernels.minimise(at, limits, number, settled)
    kernels.check_pixels()
    if found is not None:
        return found
    for stage, steps in stages:
        at = _minimise_stage(at, stage, steps, settled)
    if number is None:
        return at, None
    tukey = at._replace(fit=at.fit._replace(huber=False, noise=0.0))
    return at, kernels.score(number, tukey)


def _minimise_stage(at: Estimate, stage: _Stage, steps: int, settled: float) -> Estimate:
    """Levenberg-Marquardt at one stage. The last step is not checked by a render."""
    frame, damping = stage.kernels.frame, DAMPING
    first = frame(stage.number, at.pose)
    if not at.noise:  # the exposure is unknown
        at = _moved(at, stage.sums(first, at), np.zeros(6))
    sums = stage.sums(first, at)
    for number in range(steps):
        step = _solved(sums, damping)
        tried, size = _moved(at, sums, step), stage.pixels(step[:6], sums)
        if size < settled or number == steps - 1:
            return tried
        candidate = stage.sums(frame(stage.number, tried.pose), tried, sums.noise)
        if candidate.cost_before <= sums.cost:
            at, sums, damping = tried, candidate, max(damping / 10, 1e-6)
        else:
            damping *= 10
    return at


def _finish(at: Estimate, score: Score, stage: _Stage, camera: Camera) -> Alignment:
    """Run the last steps; if they do not converge, run them again after steps with Huber's loss. Tukey's loss
    is not convex, and ignores edges displaced by more than a fraction of a pixel."""
    alignment, settled = _last_steps(at, score, stage, camera)
    if settled:
        return alignment
    at, again = _minimise(at, [(stage, _FULL_STEPS)], stage, _FULL_SETTLED)
    assert again is not None
    return _last_steps(at, again, stage, camera)[0]


def _last_steps(at: Estimate, score: Score, stage: _Stage, camera: Camera) -> tuple[Alignment, bool]:
    """Minimise Tukey's loss by Newton's method with a line search. Returns the alignment, with an infinite
    covariance if the pixels do not determine it, and whether all steps decreased the loss and converged. The
    derivative of the score is that of the first step."""
    at, sums = Estimate(at.pose, at.fit._replace(huber=False)), score.sums
    inverse, best, settled, rejected = _inverse(sums, _bread(score)), (at, sums), False, False
    step = np.zeros(6 + 2 * len(at.fit.gain))
    for number in range(_LAST_STEPS):
        if number:
            fit = at.fit._replace(noise=best[1].noise)
            sums = stage.kernels.block_sums(stage.number, at._replace(fit=fit))
            if sums.cost_before > _INCREASE * best[1].cost:
                step, rejected = step / 4, True
                at = _moved(best[0], best[1], step)
                continue
        best = at, sums
        if settled := inverse is None:
            break
        step, errors = inverse @ _right(sums), (_scores(sums) @ inverse.T)[:, :6]
        at = _moved(at, sums, step)
        square = step[:6] @ np.linalg.lstsq(errors.T @ errors, step[:6], rcond=None)[0]
        exact = sums.noise > 1.001 * MIN_NOISE or stage.pixels(step[:6], sums) < _REPEATED_PIXELS
        if settled := square < _REPEATED**2 and exact:
            break
    sums, image_noise = best[1], max(stage.kernels.noise, MIN_IMAGE_NOISE)
    covariance = np.diag(np.full(6, np.inf)) if inverse is None else _covariance(sums, inverse)
    inliers, excess = _agreement(sums, image_noise / float(np.median(at.fit.gain)))
    alignment = Alignment(camera.with_pose(at.pose), excess * covariance, inliers, sums.noise, at.fit.gain)
    return alignment, bool(settled) and not rejected


def _agreement(sums: AlignmentSums, noise: float) -> tuple[float, float]:
    """Fraction of matching blocks, and their reduced chi-squared.

    A block matches if the normalised correlation (NCC) of image and render is above MIN_CORRELATION. The
    denominator is the number of blocks with contrast, at least MIN_BLOCKS. The chi-squared is its third
    quartile relative to that of noise alone, at least 1.

    noise: standard deviation of the noise of the image, in units of the render.
    """
    count = np.maximum(sums.block_moments[:, :, 5], 1)
    x, y, xx, yy, xy = np.moveaxis(sums.block_moments[:, :, :5] / count[:, :, None], 2, 0)
    image, render = (xx - x * x).mean(axis=1) - noise**2, (yy - y * y).mean(axis=1)
    used = np.maximum(image, render) > max(MIN_CONTRAST, 2 * noise) ** 2
    used &= count[:, 0] >= MIN_PIXELS
    correlation = (xy - x * y).mean(axis=1) / np.sqrt(np.maximum(image * render, 1e-12))
    match = used & (correlation > MIN_CORRELATION)
    squares = (xx + yy - 2 * xy).mean(axis=1)[match] / noise**2
    excess = max(1.0, float(np.quantile(squares, 0.75)) / _QUARTILE) if match.any() else 1.0
    return float(match.sum() / max(used.sum(), MIN_BLOCKS)), excess


def _bread(score: Score) -> np.ndarray:
    """Derivative of the score with respect to pose and exposure."""
    matrix = score.sums.matrix
    columns = np.concatenate([np.zeros((len(matrix), 8, 6)), matrix[:, :, 6:]], axis=2)
    for axis, rhs in score.derivatives.items():
        columns[:, :, axis] = rhs[:, :, 0]
        if len(score.derivatives) < 6:  # see `AlignmentKernels.axes`
            columns[:, :, axis // 3 * 3 + 2] += rhs[:, :, 1]
    return _assembled(columns)


def _inverse(sums: AlignmentSums, bread: np.ndarray) -> np.ndarray | None:
    """The inverse of the derivative of the score; None if the pixels do not determine the pose, or if there
    are too few blocks of pixels for a covariance."""
    if np.count_nonzero(sums.block_matrices.any(axis=(1, 2, 3))) <= len(bread):
        return None
    deviations = np.sqrt(np.maximum(np.diag(_assembled(sums.matrix)), 1e-15))
    scaled = bread / np.outer(deviations, deviations)
    if np.linalg.matrix_rank(scaled, MIN_INFORMATION) < len(bread):
        return None
    return np.linalg.inv(scaled) / np.outer(deviations, deviations)


def _covariance(sums: AlignmentSums, inverse: np.ndarray) -> np.ndarray:
    """(6, 6) sandwich estimate from the scores of blocks, corrected for leverage by the delete-one-block
    jackknife (CR3, MacKinnon and White 1985)."""
    count, size = len(sums.block_rhs), len(inverse)
    matrices = np.zeros((count, size, size))
    for channel in range(sums.block_rhs.shape[1]):
        used = np.array(_parameters(channel))
        matrices[:, used[:, None], used] += sums.block_matrices[:, channel]
    # more than 1: a single block may determine the pose, which makes the difference singular
    others = 1.000001 * np.eye(size) - inverse @ matrices
    errors = np.linalg.solve(others, (_scores(sums) @ inverse.T)[:, :, None])[:, :6, 0]
    return errors.T @ errors * (count - 1) / count


def _scores(sums: AlignmentSums) -> np.ndarray:
    """Scores (blocks, 6 + 2 c): gradients of the loss of each block, by pose, gain and offset of channels."""
    scores = np.zeros((len(sums.block_rhs), 6 + 2 * sums.block_rhs.shape[1]))
    for channel in range(sums.block_rhs.shape[1]):
        scores[:, _parameters(channel)] += sums.block_rhs[:, channel]
    return scores


def _solved(sums: AlignmentSums, damping: float) -> np.ndarray:
    """Step (6 + 2 c,) of Levenberg-Marquardt, with damped pose."""
    matrix = _assembled(sums.matrix)
    diagonal = np.diag(matrix)[:6]
    matrix[range(6), range(6)] += damping * diagonal + 1e-9 * max(float(diagonal.sum()), 1e-9)
    return np.linalg.solve(matrix, _right(sums))


def _right(sums: AlignmentSums) -> np.ndarray:
    """Right side (6 + 2 c,) of the normal equations: the gradient of the log-likelihood."""
    right = np.zeros(6 + 2 * len(sums.matrix))
    for channel, column in enumerate(sums.rhs[:, :, 0]):
        right[_parameters(channel)] += column
    return right


def _assembled(matrices: np.ndarray) -> np.ndarray:
    """The matrix (6 + 2 c, 6 + 2 c) of pose, and of gain and offset of each channel, from those (c, 8, 8) of
    the channels."""
    total = np.zeros((6 + 2 * len(matrices),) * 2)
    for channel, matrix in enumerate(matrices):
        used = _parameters(channel)
        total[np.ix_(used, used)] += matrix
        total[used[6:], used[6:]] += 1e-9 * (1 + matrix[6, 6] + matrix[7, 7])
    return total


def _parameters(channel: int) -> list[int]:
    """Indices of the pose, and of gain and offset of a channel."""
    return [*range(6), 6 + 2 * channel, 7 + 2 * channel]


def _exposure_of(sums: AlignmentSums) -> tuple[np.ndarray, np.ndarray]:
    """Changes (c,) of gains and offsets that equalise the means and standard deviations of the blurred
    images. A regression would underestimate the gain of misaligned images."""
    total = sums.matrix[:, 7, 7]
    values, residuals = sums.matrix[:, 6, 7] / total, sums.rhs[:, 7, 0] / total
    variance = np.maximum(sums.matrix[:, 6, 6] / total - values**2, 1e-12)
    mixed = sums.rhs[:, 6, 0] / total - values * residuals
    image = variance + 2 * mixed + sums.squared_residuals / total - residuals**2
    gains = np.sqrt(np.maximum(image, 1e-12) / variance)
    return gains, values + residuals - gains * values


def _ignored(mask: np.ndarray | None, camera: Camera) -> np.ndarray | None:
    """Image (h, w) float32 with 1 for ignored pixels and outside the field of view, whose border does not
    move with the scene; None without such pixels."""
    if mask is None and camera.lens is None:
        return None
    ignored = np.zeros((camera.height, camera.width), np.float32)
    if mask is not None:
        ignored = resized(~mask, camera.width, camera.height)
    if camera.lens is not None:
        y, x = np.mgrid[: camera.height, : camera.width]
        rays = camera.rays(np.stack([x.ravel(), y.ravel()], axis=1) + 0.5)
        ignored[np.isnan(rays).any(axis=1).reshape(ignored.shape)] = 1
    return ignored
