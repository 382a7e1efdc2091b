"""Splat model in device memory, with loss and Adam in the device's training kernels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.backends.interface import DeviceCloud, Images
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.train.dataset import TrainingView
from fidsplat.train.densify import Densification, limited_logits
from fidsplat.train.losses import Loss
from fidsplat.train.mcmc import NOISE_CUTOFF, NOISE_SLOPE
from fidsplat.train.optimiser import HIGHER_SH_RATE
from fidsplat.train.parameters import NAMES, SHAPES, Splats
from fidsplat.train.random_numbers import RandomStream
from fidsplat.train.settings import TrainSettings
from fidsplat.train.view_refinement import ViewRefinement, ViewStep, camera_intrinsics

_PREFIXES = ("", "first_", "second_")
_STATISTICS = ("gradient_sums", "visible_counts")


class DeviceModel:
    """Splats in training in device memory, with the images of the data set."""

    def __init__(self, kernels: Any, views: Sequence[TrainingView], settings: TrainSettings) -> None:
        """kernels: training kernels of a backend (`Backend.training`)."""
        self._kernels, self._settings = kernels, settings
        self.max_pending_losses = kernels.max_pending_losses
        cameras = [view.camera for view in views]
        intrinsics = np.array([camera_intrinsics(camera)[2:] for camera in cameras])
        kernels.load_views([(view.image, view.mask) for view in views], intrinsics)
        self._number = 0
        self._cameras = cameras
        self._refinement: ViewRefinement | None = None

    def load(self, splats: Splats) -> None:
        """Copy splats to the device."""
        groups = (splats.values, splats.first, splats.second)
        arrays = {
            prefix + name: group[name]
            for prefix, group in zip(_PREFIXES, groups, strict=True)
            for name in NAMES
        }
        self._kernels.load(arrays | {name: getattr(splats, name) for name in _STATISTICS})
        self._number = len(splats)

    def read(self) -> Splats:
        """A copy of the splats in host memory."""
        arrays = self._kernels.read()
        values, first, second = ({name: arrays[prefix + name] for name in NAMES} for prefix in _PREFIXES)
        return Splats(values, first, second, *(arrays[name] for name in _STATISTICS))

    def geometry(self) -> Splats:
        """A copy of the splats without harmonics and moments."""
        arrays = self._kernels.read((*SHAPES, *_STATISTICS))
        return Splats(
            {name: arrays[name] for name in SHAPES}, {}, {}, *(arrays[name] for name in _STATISTICS)
        )

    def densify(self, densification: Densification) -> None:
        """Clone, split and prune splats; only new values are copied from the host."""
        self._kernels.gather_rows(densification.rows, densification.remaining)
        self._kernels.write(
            {"means": densification.means, "log_scales": densification.log_scales}, densification.first_split
        )
        self._kernels.clear(_STATISTICS)
        self._number = len(densification.rows)

    def reset_opacities(self) -> None:
        """Limit opacities to `reset_opacity`, and set their moments to 0."""
        logits = limited_logits(self._kernels.read(("logits",))["logits"], self._settings)
        self._kernels.load({"logits": logits})
        self._kernels.clear(("first_logits", "second_logits"))

    def __len__(self) -> int:
        return self._number

    def resident(self, degree: int, origin: np.ndarray) -> DeviceCloud:
        """The splats as a cloud to render, with SH of this degree."""
        return self._kernels.resident(degree, origin)

    def refine(self, refinement: ViewRefinement, views: Sequence[View]) -> None:
        """Refine the views in later steps. views: their uniforms, with the cameras of the data set."""
        self._refinement = refinement
        settings = {
            "refine_pose": int(self._settings.refine_poses),
            "refine_intrinsics": int(self._settings.refine_intrinsics),
            "refine_exposure": int(self._settings.fit_exposures),
        }
        self._kernels.load_refinement(
            refinement.arrays(), views, refinement.rows, refinement.depths, settings
        )

    def read_refinement(self) -> None:
        """Copy refined cameras and exposures to the host."""
        if self._refinement is not None:
            self._refinement.set_arrays(self._kernels.read_refinement())

    def camera(self, view: int) -> Camera:
        """The camera of the captures of a view; the device replaces it by the refined one."""
        return self._cameras[view]

    def refined_view(self, pipeline: Any, view: View, number: int) -> View:
        """The uniforms of view `number` with the refined camera."""
        return view if self._refinement is None else self._kernels.refined_view(pipeline, view, number)

    def loss(self, images: Images, view: int) -> tuple[Callable[[], Loss], Any]:
        """A function that waits for the loss of a rendered view, and the gradient (h, w, 3) on the device."""
        settings = self._settings
        exposed = settings.fit_exposures and self._refinement is not None
        value, gradient = self._kernels.loss(images, view, settings.dssim_weight, exposed)
        return lambda: Loss(*value()), gradient

    def normal_loss_gradients(self, images: Images, view: int, weight: float) -> dict[str, Any]:
        """Gradients of the weighted normal loss with respect to `depth` and `normal`."""
        return self._kernels.normal_loss_gradients(images, view, weight)

    def backward_per_tile(self, pipeline: Any, images: Images, gradients: Mapping[str, Any]) -> Any:
        """The backward pass up to the gradients by tile, for `accumulate_statistics` and `step`."""
        return pipeline.backward_per_tile(images, gradients)

    def accumulate_statistics(self, by_tiles: Any, camera: Camera, origin: np.ndarray) -> None:
        """Add screen-space gradients and visibility to the densification statistics."""
        self._kernels.accumulate_statistics(by_tiles)

    def step(
        self,
        by_tiles: Any,
        rate: Mapping[str, float],
        step: int,
        camera: Camera | None,
        origin: np.ndarray,
        view_step: ViewStep | None = None,
    ) -> None:
        """Apply one step of Adam. camera: if given, statistics are accumulated first. view_step: if given,
        the view's camera and exposure are refined."""
        settings, count = self._settings, max(1, self._number)
        correction = 1 / (1 - settings.beta1**step)
        sizes = {name.removeprefix("log_"): correction * value for name, value in rate.items()}
        sizes["rest"] = HIGHER_SH_RATE * sizes["sh"]
        mcmc = settings.strategy == "mcmc"
        numbers = {
            **{"beta1": settings.beta1, "beta2": settings.beta2, "epsilon": settings.epsilon},
            "sqrt_correction2": math.sqrt(1 - settings.beta2**step),
            "sparse": float(settings.sparse_adam),
            "scale_penalty": settings.scale_penalty / (settings.axes * count) if mcmc else 0.0,
            "opacity_penalty": settings.opacity_penalty / count if mcmc else 0.0,
        }
        refined = None if view_step is None else self._refine_intrinsics(by_tiles, view_step)
        self._kernels.step(by_tiles, sizes, numbers, camera is not None, refined)

    def _refine_intrinsics(self, by_tiles: Any, step: ViewStep) -> dict[str, Any]:
        """Apply the due steps of the intrinsics; returns the other arguments of the kernel `refine_view`."""
        refinement, settings = self._refinement, self._settings
        assert refinement is not None
        for row in refinement.due_intrinsics(step):
            args = {"beta1": settings.beta1, "beta2": settings.beta2, "intrinsics_row": row}
            args["intrinsics_rate"] = refinement.intrinsics_rate(row, step.iteration)
            self._kernels.refine_intrinsics(by_tiles, args, len(self._cameras))
        return {
            **{"view_index": step.view, "next_view": step.next_view},
            "pose_rate": refinement.pose_rate(step.view, step.iteration),
            "exposure_rate": refinement.exposure_rate(step.view, step.iteration),
        }

    def centre_exposures(self) -> None:
        """Set the means of the exposures over the views to 0; the splats' colours then compensate."""
        self._kernels.centre_exposures(len(self._cameras))

    def add_noise(self, iteration: int, rate: float) -> None:
        """Add MCMC noise to the means. rate: learning rate of the means [m]."""
        seed = self._settings.seed
        words = (seed & 0xFFFFFFFF, seed >> 32, iteration, int(RandomStream.NOISE))
        self._kernels.add_noise(rate * self._settings.noise, NOISE_SLOPE, 1 - NOISE_CUTOFF, words)
