"""Sums over pixels for direct image alignment in NumPy, for devices without alignment kernels."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from fidsplat.backends.alignment import (
    BINS,
    FIRST_BIN,
    HUBER,
    MAX_NOISE,
    MIN_NOISE,
    SHIFT,
    TUKEY,
    AlignmentFit,
    AlignmentKernels,
    AlignmentSums,
    CoarseToFineStage,
    PerturbedFrame,
    RenderedScene,
    bins_of,
    lowest_bin,
    noise_factor,
    noise_of,
)
from fidsplat.capture.capture import Capture
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.vision.pyramid import convolved, resized


def rendered_scene(renderer: Renderer, resident: ResidentCloud, capture: Capture) -> RenderedScene:
    """An uploaded scene for alignment. capture: with the outputs rgb and depth."""
    render = partial(renderer.render, resident)
    return RenderedScene(renderer.backend, resident.all_splats, resident.data, capture, render)


def kernels_for(scene: RenderedScene) -> AlignmentKernels:
    """Alignment kernels of the device, or else NumPy, as for stores, whose frames may be on the host."""
    if scene.backend.has("alignment") and scene.cloud is scene.splats:
        return scene.backend.alignment()
    return HostAlignment()


class HostAlignment(AlignmentKernels):
    """Sums on the host over the textured pixels of a stage."""

    def load(
        self, image: np.ndarray, stages: list[CoarseToFineStage], max_pixels: int, scene: RenderedScene
    ) -> None:
        """Prepare the image for its stages."""
        self._stages, self._scene, camera = stages, scene, stages[-1].camera
        if image.dtype == np.uint8:
            image = np.multiply(image, np.float32(1 / 255), dtype=np.float32)
        self._image = resized(image, camera.width, camera.height)
        self._targets = [_Target(self._image, stage, max_pixels) for stage in stages]
        self._rendered: tuple[Any, ...] = ()

    @property
    def pixels(self) -> list[int]:
        """Number of used pixels of each stage."""
        return [len(target.rows) for target in self._targets]

    @property
    def noise(self) -> float:
        """Standard deviation of the noise of the image."""
        rows = self._image[::8]
        changes = np.abs(rows[:, 1:-1] - (rows[:, :-2] + rows[:, 2:]) / 2)
        return noise_of(_median(changes.ravel())) if changes.size else 0.0

    def sums(
        self,
        stage: int,
        frame: Any,
        fit: AlignmentFit,
        perturbed: PerturbedFrame | None = None,
        blocks: bool = False,
    ) -> AlignmentSums:
        target = self._targets[stage]
        values, slopes, inverse_depth = self._features(target, frame)
        gain, offset = fit.gain[:, None].astype(np.float32), fit.offset[:, None].astype(np.float32)
        residuals = (target.values - offset) / gain - values
        if fit.huber:
            slopes = (slopes + target.slopes / gain) / 2
        error = np.sqrt((residuals**2).mean(axis=0))
        noise = max(noise_factor(len(values)) * _median(error), MIN_NOISE)
        noise = min(noise, fit.noise) if fit.noise else noise
        normalised, weights, cost = _robust(error, noise, fit.huber)
        matrix_weights = weights
        if not fit.huber:  # the derivative of the weighted residual, averaged over directions among channels
            inner = np.maximum(1 - normalised**2, 0)
            matrix_weights = np.maximum(inner**2 - 4 * normalised**2 * inner / len(values), 0)
        across, down = np.concatenate([target.turning, target.shifting * inverse_depth], axis=1)
        columns, column_weights = residuals[None], weights
        if perturbed is not None:
            change = (_at(target.blurred(perturbed.frame), target.rows) - values) / np.float32(perturbed.size)
            columns, column_weights = (
                np.stack([change, -target.rays[perturbed.axis] * change]),
                matrix_weights,
            )
        matrix, rhs, block_rhs, block_matrices, block_moments = [], [], [], [], []
        for channel, (gx, gy) in enumerate(zip(*slopes, strict=True)):
            row = np.stack([*-(gx * across + gy * down), values[channel], np.ones_like(gx)]).astype(float)
            weighted = row * column_weights
            matrix.append((row * matrix_weights) @ row.T)
            rhs.append(weighted @ columns[:, channel].T)
            if blocks:
                block_rhs.append(target.by_block(weighted * columns[0, channel]))
                block_matrices.append(target.by_block((row * matrix_weights)[:, None] * row))
                x, y = (residuals + values)[channel].astype(float), values[channel].astype(float)
                block_moments.append(target.by_block(np.stack([x, y, x * x, y * y, x * y, np.ones_like(x)])))
        return AlignmentSums(
            np.array(matrix),
            np.array(rhs),
            (residuals**2 * weights).sum(axis=1, dtype=float),
            np.stack(block_rhs, axis=1) if blocks else np.empty((0, len(values), 8)),
            np.stack(block_matrices, axis=1) if blocks else np.empty((0, len(values), 8, 8)),
            np.stack(block_moments, axis=1) if blocks else np.empty((0, len(values), 6)),
            float(cost.mean()),
            float(_robust(error, fit.noise or noise, fit.huber)[2].mean()),
            float((inverse_depth**2).mean()),
            noise,
        )

    def _features(self, target: _Target, frame: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values, slopes and inverse depths of a frame; cached for the last frame."""
        if not self._rendered or self._rendered[0] is not target or self._rendered[1] is not frame:
            image, rows = target.blurred(frame), target.rows
            features = _at(image, rows), _slopes(image, rows), _nearest(frame["depth"], rows)
            self._rendered = target, frame, features
        return self._rendered[2]


class _Target:
    """The image at one stage, at its textured pixels."""

    def __init__(self, image: np.ndarray, stage: CoarseToFineStage, max_pixels: int) -> None:
        camera, self.taps = stage.camera, stage.taps
        width, height = camera.width, camera.height
        values = convolved(resized(image, width, height), stage.taps)
        bins = np.zeros((height, width), np.int64)
        across, down = values[1:-1, 2:] - values[1:-1, :-2], values[2:, 1:-1] - values[:-2, 1:-1]
        bins[1:-1, 1:-1] = bins_of(np.sqrt((across * across + down * down).sum(axis=2)) / 2)
        if stage.ignored is not None:
            bins[stage.ignored] = 0
        self.rows = rows = np.flatnonzero(
            bins >= lowest_bin(np.bincount(bins.ravel(), minlength=BINS), max_pixels)
        )
        self.values, self.slopes = _at(values, rows), _slopes(values, rows)
        y, x = np.divmod(rows, width)
        blocks = y // stage.block_size * width + x // stage.block_size
        self._order = np.argsort(blocks, kind="stable")
        self._starts = np.unique(blocks[self._order], return_index=True)[1]
        rays = camera.rays(np.stack([x, y], axis=1) + 0.5)
        if camera.lens is None:
            by_point = np.zeros((len(rays), 2, 3))
            by_point[:, [0, 1], [0, 1]], by_point[:, :, 2] = 1, -rays[:, :2]
        else:
            by_point = camera.lens.derivative(rays)
        by_point = by_point * np.array([camera.fx, camera.fy])[:, None]
        turning = np.cross(rays[:, None], by_point)  # g . (w x ray) = w . (ray x g)
        self.turning, self.shifting = (
            np.ascontiguousarray(np.moveaxis(a, 0, 2), np.float32) for a in (turning, by_point)
        )
        """(2, 3, n) derivatives of pixel coordinates x and y with respect to a rotation of the camera axes,
        and to a translation of points at depth 1"""
        self.rays = rays.T.astype(np.float32)

    def by_block(self, values: np.ndarray) -> np.ndarray:
        """(blocks, ...) sums over the pixels of each block of (..., n) values."""
        return np.moveaxis(np.add.reduceat(values[..., self._order], self._starts, axis=-1), -1, 0)

    def blurred(self, frame: Any) -> np.ndarray:
        """(h, w, c) colours of a frame with the blur and the channels of the image."""
        rgb = frame["rgb"]
        rgb = rgb.mean(axis=2, keepdims=True) if len(self.values) == 1 else rgb
        return convolved(np.ascontiguousarray(rgb), self.taps)


def _robust(error: np.ndarray, noise: float, huber: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors relative to the robust threshold, weights and losses."""
    if huber:
        normalised = error / np.float32(HUBER * noise)
        return (
            normalised,
            1 / np.maximum(normalised, 1),
            np.where(normalised < 1, normalised**2 / 2, normalised - 0.5),
        )
    normalised = error / np.float32(TUKEY * min(noise, MAX_NOISE))
    inner = np.maximum(1 - normalised**2, 0)
    return normalised, inner**2, 1 - inner**3


def _median(values: np.ndarray) -> float:
    """Median from a histogram, linear within its bin."""
    counts = np.bincount(bins_of(values), minlength=BINS)
    before = np.cumsum(counts) - counts
    at = int(np.flatnonzero(before <= len(values) / 2)[-1])
    low, high = (np.array([FIRST_BIN + at, FIRST_BIN + at + 1], np.uint32) << SHIFT).view(np.float32).tolist()
    return low + (high - low) * (len(values) / 2 - before[at]) / max(int(counts[at]), 1)


def _at(image: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(c, n) values of an image (h, w, c) at some pixels."""
    return np.ascontiguousarray(image.reshape(-1, image.shape[2]).take(rows, axis=0).T)


def _slopes(image: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(2, c, n) central differences by x and y of an image (h, w, c) at pixels that are not on its border."""
    width = image.shape[1]
    differences = [_at(image, rows + step) - _at(image, rows - step) for step in (1, width)]
    return np.stack(differences) / 2


def _nearest(depth: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Inverse depths (n,), 0 for the background: the largest of a pixel and its neighbours, as the gradient
    at an edge is of the surface in front."""
    flat, width = depth.reshape(-1), depth.shape[1]
    inverse = np.zeros_like(flat)
    np.divide(1, flat, out=inverse, where=flat > 0)
    near = inverse[rows]
    for shift in (-1, 1, -width, width):
        near = np.maximum(near, inverse[rows + shift])
    return near
