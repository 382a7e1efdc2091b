"""The work of a training step around the picture, in NumPy: for backends that have no kernels for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.backends.gradients import on_host
from fidsplat.backends.interface import Backend, Images, ResidentData
from fidsplat.cameras import Camera
from fidsplat.train import mcmc
from fidsplat.train.dataset import TrainingView
from fidsplat.train.densify import Densification, limited_logits
from fidsplat.train.losses import Loss, image_loss, normal_loss
from fidsplat.train.optimiser import adam_step, contributing, parameter_gradients, sparse_adam_step
from fidsplat.train.parameters import Splats
from fidsplat.train.settings import TrainSettings

_REACH = 3.0
"""standard deviations to which a splat counts as seen"""


class HostWork:
    """Splats in training in the host's memory, with the pictures that they are compared with."""

    late = 0
    """losses that may be asked for after later pictures"""

    def __init__(self, backend: Backend, views: Sequence[TrainingView], settings: TrainSettings) -> None:
        self._backend, self._views, self._settings = backend, views, settings
        self._splats: Splats

    def load(self, splats: Splats) -> None:
        """Takes over splats, which this changes from now on."""
        self._splats = splats

    def store(self) -> Splats:
        """The splats as they are now."""
        return self._splats

    def shapes(self) -> Splats:
        """As `store`, to look at: harmonics and what is moments may be missing."""
        return self._splats

    def make(self, made: Densification) -> None:
        """Goes on with the splats of a plan."""
        self._splats = made.apply(self._splats)

    def reset(self) -> None:
        """Makes all faint, and forgets how their opacities moved."""
        splats = self._splats
        splats.values["logits"] = limited_logits(splats.values["logits"], self._settings)
        for moments in (splats.first, splats.second):
            moments["logits"][:] = 0

    def __len__(self) -> int:
        return len(self._splats)

    def resident(self, degree: int, origin: np.ndarray) -> ResidentData:
        """The splats as the device draws them, with SH of this degree."""
        return self._backend.upload(self._splats.cloud(degree, origin, shared=True))

    def loss(self, images: Images, view: int) -> tuple[Callable[[], Loss], np.ndarray]:
        """What gives the loss of a picture of a view, by its number, and its derivative (h, w, 3)."""
        of = self._views[view]
        truth = of.image * np.float32(1 / 255)
        loss, slope = image_loss(images.read("rgb"), truth, of.mask, self._settings.dssim_weight)
        return lambda: loss, slope

    def surface(self, images: Images, view: int, weight: float) -> dict[str, np.ndarray]:
        """Derivatives of the loss of normals by depths and normals, times its weight."""
        of = self._views[view]
        camera, counted = of.camera, np.float32(weight) * images.read("alpha")
        if of.mask is not None:
            counted *= of.mask
        lens = (camera.fx, camera.fy), (camera.cx, camera.cy)
        _, by_depth, by_normal = normal_loss(images.read("depth"), images.read("normal"), counted, *lens)
        return {"depth": by_depth, "normal": by_normal}

    def backward_to_tiles(self, pipeline: Any, images: Images, slopes: Mapping[str, Any]) -> dict[str, Any]:
        """What `count` and `step` take of a picture, from the derivatives by it."""
        return pipeline.backward(images, slopes)

    def count(self, gradients: Mapping[str, Any], camera: Camera, origin: np.ndarray) -> None:
        """Adds the gradients on the screen to their sums."""
        splats = self._splats
        splats.gradient_sums += on_host(gradients["screen"])
        splats.visible_counts += seen(splats, camera, origin)

    def step(
        self,
        gradients: Mapping[str, Any],
        rate: Mapping[str, float],
        step: int,
        camera: Camera | None,
        origin: np.ndarray,
    ) -> None:
        """One step of Adam; before it, with a camera, what `count` does."""
        if camera is not None:
            self.count(gradients, camera, origin)
        given = {name: on_host(array) for name, array in gradients.items()}
        inner = parameter_gradients(self._splats, given, self._settings)
        if self._settings.sparse_adam:
            sparse_adam_step(self._splats, contributing(given), inner, rate, self._settings, step)
        else:
            adam_step(self._splats, inner, rate, self._settings, step)

    def shake(self, iteration: int, rate: float) -> None:
        """Moves the means at random."""
        mcmc.add_noise(self._splats, self._settings, iteration, rate)


def seen(splats: Splats, camera: Camera, origin: np.ndarray) -> np.ndarray:
    """Whether (n,) a sphere of three standard deviations around a splat reaches into the picture."""
    turn = camera.world_to_camera[:3, :3].astype(np.float32)
    move = (turn.astype(np.float64) @ (origin - camera.position)).astype(np.float32)
    x, y, z = (splats.values["means"] @ turn.T + move).T
    reach = _REACH * splats.scales.max(axis=1)
    inside = z > camera.near
    for place, focal, middle, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        # of pixels times depth, so that nothing is divided by a depth of 0
        at = np.float32(focal) * place + np.float32(middle) * z
        wide = np.float32(focal) * reach
        inside &= (at + wide > 0) & (at - wide < np.float32(size) * z)
    return inside
