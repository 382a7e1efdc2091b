"""Gradients of the reference renderer in float64, with the decisions of the forward pass held constant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fidsplat.backends.gradients import NOT_LATEST_FRAME, check_shape, gradient_shape
from fidsplat.backends.interface import GradientPipeline, Images, Pipeline
from fidsplat.backends.reference.gradients_blend import Blend, Decisions, Samples, decide
from fidsplat.backends.reference.gradients_scene import (
    CameraSplats,
    Parameters,
    to_camera,
    to_camera_backward,
)
from fidsplat.backends.reference.projection import ProjectedSplats
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.effects.differentiable import GRADIENT_OUTPUTS, check_gradients
from fidsplat.util.errors import InputError

_BLOCK = 1 << 16  # (sample, splat) pairs that are evaluated at once


class ReferenceGradients(GradientPipeline):
    def __init__(self, pipeline: Pipeline, features: FeatureSet) -> None:
        self._pipeline, self._features = pipeline, features
        self._last: tuple[Images, FrozenFrame] | None = None

    def forward(self, cloud: Any, view: View, waits: bool = True) -> Images:
        images = self._pipeline.render_view(cloud, view)
        self._last = images, FrozenFrame(cloud.host_cloud, view, self._features)
        return images

    def backward(self, images: Any, gradients: Mapping[str, Any]) -> dict[str, np.ndarray]:
        check_gradients(self._features, gradients)
        if self._last is None or self._last[0] is not images:
            raise InputError(NOT_LATEST_FRAME)
        frame = self._last[1]
        return frame.backward({name: np.asarray(array, np.float64) for name, array in gradients.items()})


class FrozenFrame:
    """A frame as a differentiable function of its parameters, with its decisions held constant."""

    def __init__(self, cloud: Any, view: View, features: FeatureSet) -> None:
        self.parameters = Parameters.of(cloud, view)
        self._view, self._features = view, features
        self._projected = ProjectedSplats(cloud, view, features)
        self._blocks: list[tuple[np.ndarray, np.ndarray, Decisions]] = []
        rows, columns = np.mgrid[0 : view.height, 0 : view.width]
        x, y = columns.ravel() + 0.5, rows.ravel() + 0.5
        step = max(1, _BLOCK // max(1, len(self._projected.order)))
        for k in range(0, len(x), step):
            at = x[k : k + step], y[k : k + step]
            self._blocks.append((*at, decide(self._projected, view, *at)))

    def images(self, parameters: Parameters) -> dict[str, np.ndarray]:
        """Render output images (float64) with other parameters, under the frozen decisions."""
        parts = [
            _images(blend.samples, decisions, parameters) for blend, decisions in self._blend(parameters)
        ]
        height, width = self._view.height, self._view.width
        whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return {name: image.reshape(height, width, *image.shape[1:]) for name, image in whole.items()}

    def backward(self, gradients: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Gradients with respect to the parameters, and `grad2d`, from gradients with respect to the
        images."""
        view, parameters = self._view, self.parameters
        flat = {}
        for name in GRADIENT_OUTPUTS:
            given = gradients[name] if name in gradients else np.zeros(gradient_shape(name, view))
            check_shape(name, given.shape, view)
            flat[name] = given.reshape(view.height * view.width, *given.shape[2:])
        splat_grads, grad_background, start = CameraSplats.zeros(len(parameters.means)), np.zeros(3), 0
        for blend, decisions in self._blend(parameters):
            rows = slice(start, start + len(decisions.covered))
            start = rows.stop
            samples = blend.samples
            pixel_grads = {name: array[rows] for name, array in flat.items()}
            grad_background += samples.t @ pixel_grads["rgb"]
            results = blend.backward(_images_backward(pixel_grads, samples, decisions, parameters))
            for name, values in vars(results).items():
                getattr(splat_grads, name)[...] += values
        splats = to_camera(parameters, view)
        # gradient with respect to the projected centre in units of half images, as in 2DGS; for EWA at a
        # constant projected covariance, as in 3DGS
        z = splats.p[:, 2]
        across = z[:, None] * splat_grads.p[:, :2] / (view.focal_x, view.focal_y)
        if "ellipsoid_exact" not in self._features.effects:
            across = np.where(splats.scales[:, 2:] > 0, 0.0, across)
        grad_center = splat_grads.center + across
        grad2d = 0.5 * np.sign(z) * np.hypot(view.width * grad_center[:, 0], view.height * grad_center[:, 1])
        return {
            **to_camera_backward(parameters, view, splats, splat_grads),
            **{"background": grad_background, "grad2d": grad2d},
        }

    def _blend(self, parameters: Parameters) -> Iterator[tuple[Blend, Decisions]]:
        view = parameters.view(self._view)
        splats = to_camera(parameters, view)
        for x, y, decisions in self._blocks:
            yield Blend(splats, view, self._features, decisions, x, y), decisions


def _images(samples: Samples, decisions: Decisions, parameters: Parameters) -> dict[str, np.ndarray]:
    """Pixels (k,) or (k, 3) from their samples."""
    length = np.linalg.norm(samples.normal, axis=1)
    has_normal = decisions.covered & (length > 0)
    return {
        "rgb": samples.rgb + samples.t[:, None] * parameters.background,
        "alpha": 1 - samples.t,
        "depth": np.where(
            decisions.covered, samples.depth / np.where(decisions.covered, samples.weight, 1), 0.0
        ),
        "distortion": samples.weight * samples.squares - samples.inverse**2,
        "normal": np.where(
            has_normal[:, None], samples.normal / np.where(has_normal, length, 1)[:, None], 0.0
        ),
    }


def _images_backward(
    grads: Mapping[str, np.ndarray], samples: Samples, decisions: Decisions, parameters: Parameters
) -> Samples:
    """Gradients with respect to samples, from gradients with respect to pixels."""
    weight = np.where(decisions.covered, samples.weight, np.inf)
    depth = np.where(decisions.covered, samples.depth / weight, 0.0)
    length = np.linalg.norm(samples.normal, axis=1)
    length = np.where(decisions.covered & (length > 0), length, np.inf)[:, None]
    normal = samples.normal / length
    return Samples(
        rgb=grads["rgb"],
        t=grads["rgb"] @ parameters.background - grads["alpha"],
        depth=grads["depth"] / weight,
        weight=grads["distortion"] * samples.squares - grads["depth"] * depth / weight,
        inverse=-2 * grads["distortion"] * samples.inverse,
        squares=grads["distortion"] * samples.weight,
        normal=(grads["normal"] - normal * (normal * grads["normal"]).sum(1, keepdims=True)) / length,
    )
