"""Splat model in host memory, with loss and Adam in NumPy, for devices without training kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.backends.gradients import on_host
from fidsplat.backends.interface import Backend, DeviceCloud, Images
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.train import mcmc
from fidsplat.train.dataset import TrainingView
from fidsplat.train.densify import Densification, limited_logits
from fidsplat.train.losses import Loss, exposed_loss, normal_loss
from fidsplat.train.optimiser import adam_step, contributing, parameter_gradients, sparse_adam_step
from fidsplat.train.parameters import Splats
from fidsplat.train.settings import TrainSettings
from fidsplat.train.view_refinement import ViewRefinement, ViewStep

_REACH = 3.0
"""radius of a splat's bounding sphere for the visibility statistic, in standard deviations"""


class HostModel:
    """Splats in training in host memory, with the images of the data set."""

    max_pending_losses = 0
    """number of later frames after which a loss may still be read"""

    def __init__(self, backend: Backend, views: Sequence[TrainingView], settings: TrainSettings) -> None:
        self._backend, self._views, self._settings = backend, views, settings
        self._splats: Splats
        self._refinement: ViewRefinement | None = None
        self._by_exposure: np.ndarray | None = None
        """gradient with respect to the exposure of the last frame"""

    def load(self, splats: Splats) -> None:
        """Start from these splats; training updates their arrays in place."""
        self._splats = splats

    def read(self) -> Splats:
        """The splats."""
        return self._splats

    def geometry(self) -> Splats:
        """The splats, read-only; other models omit harmonics and moments."""
        return self._splats

    def densify(self, densification: Densification) -> None:
        """Clone, split and prune splats."""
        self._splats = densification.apply(self._splats)

    def reset_opacities(self) -> None:
        """Limit opacities to `reset_opacity`, and set their moments to 0."""
        splats = self._splats
        splats.values["logits"] = limited_logits(splats.values["logits"], self._settings)
        for moments in (splats.first, splats.second):
            moments["logits"][:] = 0

    def __len__(self) -> int:
        return len(self._splats)

    def resident(self, degree: int, origin: np.ndarray) -> DeviceCloud:
        """The splats as a cloud to render, with SH of this degree."""
        return self._backend.upload(self._splats.cloud(degree, origin, shared=True))

    def refine(self, refinement: ViewRefinement, views: Sequence[View]) -> None:
        """Refine the views in later steps."""
        self._refinement = refinement

    def read_refinement(self) -> None:
        """Nothing to do: refined cameras and exposures are in host memory."""

    def camera(self, view: int) -> Camera:
        """The current camera of a view."""
        return self._views[view].camera if self._refinement is None else self._refinement.camera(view)

    def refined_view(self, pipeline: Any, view: View, number: int) -> View:
        """The uniforms of view `number`, unchanged: they have the refined camera."""
        return view

    def loss(self, images: Images, view: int) -> tuple[Callable[[], Loss], np.ndarray]:
        """A function that returns the loss of a rendered view, and the gradient (h, w, 3)."""
        image, mask = self._views[view].image, self._views[view].mask
        target, weight = image * np.float32(1 / 255), self._settings.dssim_weight
        fitted = self._refinement if self._settings.fit_exposures else None
        exposure = None if fitted is None else fitted.exposures[view]
        rgb = images.read("rgb", 0)
        loss, gradient, self._by_exposure = exposed_loss(rgb, target, mask, weight, exposure)
        return lambda: loss, gradient

    def normal_loss_gradients(self, images: Images, view: int, weight: float) -> dict[str, np.ndarray]:
        """Gradients of the weighted normal loss with respect to `depth` and `normal`."""
        camera = self.camera(view)
        mask, weights = self._views[view].mask, np.float32(weight) * images.read("alpha", 0)
        if mask is not None:
            weights *= mask
        lens = (camera.fx, camera.fy), (camera.cx, camera.cy)
        depth, normal = images.read("depth", 0), images.read("normal", 0)
        _, by_depth, by_normal = normal_loss(depth, normal, weights, *lens)
        return {"depth": by_depth, "normal": by_normal}

    def backward_per_tile(
        self, pipeline: Any, images: Images, gradients: Mapping[str, Any]
    ) -> dict[str, Any]:
        """The gradients for `accumulate_statistics` and `step`."""
        return pipeline.backward(images, gradients)

    def accumulate_statistics(self, gradients: Mapping[str, Any], camera: Camera, origin: np.ndarray) -> None:
        """Add screen-space gradients and visibility to the densification statistics."""
        splats = self._splats
        splats.gradient_sums += on_host(gradients["grad2d"])
        splats.visible_counts += visible(splats, camera, origin)

    def step(
        self,
        gradients: Mapping[str, Any],
        rate: Mapping[str, float],
        step: int,
        camera: Camera | None,
        origin: np.ndarray,
        view_step: ViewStep | None = None,
    ) -> None:
        """Apply one step of Adam. camera: if given, statistics are accumulated first. view_step: if given,
        the view's camera and exposure are refined."""
        if camera is not None:
            self.accumulate_statistics(gradients, camera, origin)
        arrays = {name: on_host(array) for name, array in gradients.items()}
        raw = parameter_gradients(self._splats, arrays, self._settings)
        if self._settings.sparse_adam:
            sparse_adam_step(self._splats, contributing(arrays), raw, rate, self._settings, step)
        else:
            adam_step(self._splats, raw, rate, self._settings, step)

        if view_step is not None:
            self._refine_view(arrays, view_step)

    def _refine_view(self, gradients: Mapping[str, np.ndarray], step: ViewStep) -> None:
        refinement, settings, view, iteration = self._refinement, self._settings, step.view, step.iteration
        assert refinement is not None
        for row in refinement.due_intrinsics(step):
            refinement.change_intrinsics(row, iteration)
        if settings.refine_poses:
            refinement.move(view, gradients["pose"], iteration)
        if settings.refine_intrinsics:
            refinement.add_intrinsics(view, gradients["intrinsics"])
        if self._by_exposure is not None:
            refinement.expose(view, self._by_exposure, iteration)

    def centre_exposures(self) -> None:
        """Set the means of the exposures over the views to 0; the splats' colours then compensate."""
        assert self._refinement is not None
        self._refinement.centre_exposures()

    def add_noise(self, iteration: int, rate: float) -> None:
        """Add MCMC noise to the means. rate: learning rate of the means [m]."""
        mcmc.add_noise(self._splats, self._settings, iteration, rate)


def visible(splats: Splats, camera: Camera, origin: np.ndarray) -> np.ndarray:
    """Mask (n,) of the splats whose bounding sphere of three standard deviations intersects the frustum."""
    rotation = camera.world_to_camera[:3, :3].astype(np.float32)
    translation = (rotation.astype(np.float64) @ (origin - camera.position)).astype(np.float32)
    x, y, z = (splats.values["means"] @ rotation.T + translation).T
    extents = _REACH * splats.scales.max(axis=1)
    inside = z > camera.near
    for coordinate, focal, center, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        # lengths are in pixels times depth, to avoid a division by a depth of 0
        at = np.float32(focal) * coordinate + np.float32(center) * z
        radius = np.float32(focal) * extents
        inside &= (at + radius > 0) & (at - radius < np.float32(size) * z)
    return inside
