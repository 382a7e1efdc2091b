"""The work of a training step around the picture, by a device's kernels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.backends.interface import Images, ResidentData, TrainingKernels
from fidsplat.cameras import Camera
from fidsplat.train.dataset import TrainingView
from fidsplat.train.densify import Densification, limited_logits
from fidsplat.train.losses import Loss
from fidsplat.train.mcmc import NOISE_CUTOFF, NOISE_SLOPE
from fidsplat.train.optimiser import HIGHER_SH_RATE
from fidsplat.train.parameters import NAMES, SHAPES, Splats
from fidsplat.train.random_numbers import Purpose
from fidsplat.train.settings import TrainSettings

_PREFIXES = ("", "first_", "second_")
_COUNTED = ("gradients", "seen")


class DeviceWork:
    """As `fidsplat.train.host.HostWork`, with the splats on the device."""

    def __init__(
        self, kernels: TrainingKernels, views: Sequence[TrainingView], settings: TrainSettings
    ) -> None:
        self._kernels, self._settings = kernels, settings
        self.late = kernels.late
        kernels.take_views([(view.image, view.mask) for view in views])
        self._cameras = [view.camera for view in views]
        self._number = 0

    def load(self, splats: Splats) -> None:
        """Takes over splats."""
        groups = (splats.values, splats.first, splats.second)
        arrays = {
            prefix + name: group[name]
            for prefix, group in zip(_PREFIXES, groups, strict=True)
            for name in NAMES
        }
        self._kernels.load(arrays | {"gradients": splats.gradient_sums, "seen": splats.visible_counts})
        self._number = len(splats)

    def store(self) -> Splats:
        """The splats as they are now, in the host's memory."""
        arrays = self._kernels.store()
        values, first, second = ({name: arrays[prefix + name] for name in NAMES} for prefix in _PREFIXES)
        return Splats(values, first, second, arrays["gradients"], arrays["seen"])

    def shapes(self) -> Splats:
        """As `store`, without harmonics and what is remembered."""
        arrays = self._kernels.store((*SHAPES, *_COUNTED))
        return Splats({name: arrays[name] for name in SHAPES}, {}, {}, *(arrays[name] for name in _COUNTED))

    def make(self, made: Densification) -> None:
        """Goes on with the splats of a plan, most of which never leaves the device."""
        self._kernels.pick(made.rows, made.remaining)
        self._kernels.write({"means": made.means, "log_scales": made.log_scales}, made.first_split)
        self._kernels.clear(_COUNTED)
        self._number = len(made.rows)

    def reset(self) -> None:
        """Makes all faint, and forgets how their opacities moved."""
        logits = limited_logits(self._kernels.store(("logits",))["logits"], self._settings)
        self._kernels.load({"logits": logits})
        self._kernels.clear(("first_logits", "second_logits"))

    def __len__(self) -> int:
        return self._number

    def resident(self, degree: int, origin: np.ndarray) -> ResidentData:
        """The splats as the device draws them, with SH of this degree."""
        return self._kernels.resident(degree, origin)

    def loss(self, images: Images, view: int) -> tuple[Callable[[], Loss], Any]:
        """What waits for the loss of a picture of a view, by its number; and its derivative (h, w, 3) on the
        device."""
        value, slope = self._kernels.loss(images, view, self._settings.dssim_weight)
        return lambda: Loss(*value()), slope

    def surface(self, images: Images, view: int, weight: float) -> dict[str, Any]:
        """Derivatives of the loss of normals by depths and normals, times its weight."""
        return self._kernels.surface(images, view, self._cameras[view], weight)

    def backward_to_tiles(self, pipeline: Any, images: Images, slopes: Mapping[str, Any]) -> Any:
        """What `count` and `step` take of a picture, from the derivatives by it."""
        return pipeline.backward_to_tiles(images, slopes)

    def count(self, taken: Any, camera: Camera, origin: np.ndarray) -> None:
        """Adds the gradients on the screen to their sums."""
        self._kernels.count(taken, camera, origin)

    def step(
        self,
        taken: Any,
        rate: Mapping[str, float],
        step: int,
        camera: Camera | None,
        origin: np.ndarray,
    ) -> None:
        """One step of Adam; before it, with a camera, what `count` does."""
        settings, count = self._settings, max(1, self._number)
        by_names = {
            "means": "means",
            "scales": "log_scales",
            "quats": "quats",
            "logits": "logits",
            "sh": "sh",
        }
        share = 1 / (1 - settings.beta1**step)
        sizes = {name: share * rate[of] for name, of in by_names.items()}
        sizes["rest"] = HIGHER_SH_RATE * sizes["sh"]
        mcmc = settings.strategy == "mcmc"
        numbers = {
            **{"beta1": settings.beta1, "beta2": settings.beta2, "epsilon": settings.epsilon},
            "root": math.sqrt(1 - settings.beta2**step),
            "sparse": float(settings.sparse_adam),
            "scale_penalty": settings.scale_penalty / (2 * count) if mcmc else 0.0,
            "opacity_penalty": settings.opacity_penalty / count if mcmc else 0.0,
        }
        self._kernels.step(taken, sizes, numbers, camera, origin)

    def shake(self, iteration: int, rate: float) -> None:
        """Moves the means at random (`fidsplat.train.mcmc.add_noise`)."""
        seed = self._settings.seed
        words = (seed & 0xFFFFFFFF, seed >> 32, iteration, int(Purpose.NOISE))
        self._kernels.shake(rate * self._settings.noise, NOISE_SLOPE, 1 - NOISE_CUTOFF, words)
