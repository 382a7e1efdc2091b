"""What a backend offers that takes derivatives of its pictures, and one that has the kernels of training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fidsplat.backends.interface import Backend, Images, ResidentData
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.effects import FeatureSet


class DifferentiablePipeline(Protocol):
    """The stages and their derivatives, compiled for one FeatureSet."""

    def forward(self, resident: Any, view: View, waits: bool = True) -> Images:
        """Draw one picture of an uploaded cloud, with the bits of `Pipeline.render`, and keep what `backward`
        needs of it until the device draws another one.

        waits: until it is known that there was room for all of it; if not, `backward` may say that there was
        none, and nothing of the picture counts.

        Raises:
            DeviceError: the device runs out of memory or fails; or the picture is one of those that are drawn
                in bands or chunks, which have no gradient.
        """
        ...

    def backward(self, images: Any, gradients: Mapping[str, Any]) -> dict[str, Any]:
        """From the derivatives of a loss by output images those by the splats, the background and the pose.

        Steps (the alpha cut-off, the transmittance stop, the near plane, the order of splats) have no
        derivative: they are taken as they were in the picture.

        Args:
            images: what `forward` has made last on this device.
            gradients: by the names of outputs (rgb, alpha, depth, normal, distortion) float32 arrays of their
                shape, of the device or NumPy's; outputs that are missing have gradients of 0.

        Returns:
            Arrays of the device in the cloud's shapes and units: `means` (n, 3), `quats` (n, 4), `scales`
            (n, 2), `opacities` (n,), `colors` (n, 3) or `sh` (n, k, 3), by the values that the cloud has,
            quaternions of any length among them; `screen` (n,), the norm of the derivative by the projected
            centre in units of half pictures (the statistic by which 2DGS trainers densify, their
            dL_dmean2D); `background` (3,); `pose` (6,): rotation vector [1 / rad] and translation [1 / m] of
            a motion after world_to_camera, in the camera's axes. Splats that are not drawn have zeros. They
            are the same in every bit on every run, and hold until the next call.

        Raises:
            TooLittleRoom: for a picture that was not waited for; the next one has more.
            InputError: another picture has been drawn since, or a gradient is of no output or of a wrong
                shape.
            DeviceError: the device runs out of memory or fails.
        """
        ...


class TakenBack(Protocol):
    """A picture that was taken back as far as the sums over its tiles, until the device draws another one."""

    def gradients(self) -> dict[str, Any]:
        """What `DifferentiablePipeline.backward` gives.

        Raises:
            InputError: another picture has been drawn since.
            DeviceError: the device runs out of memory or fails.
        """
        ...


class TrainedPipeline(DifferentiablePipeline, Protocol):
    """One whose derivatives `TrainingKernels` take, without an array of them."""

    def take_back(self, images: Any, gradients: Mapping[str, Any]) -> TakenBack:
        """As `backward`, for `TrainingKernels.step`."""
        ...


class TrainingKernels(Protocol):
    """The work of a training step around the picture (`fidsplat.train`), on arrays of the device.

    `late`: so many losses may be asked for after later pictures.

    It holds splats before their activations, n of them, float32: `means` (n, 3), `log_scales` (n, 2), `quats`
    (n, 4), `logits` (n,), `sh` (n, k, 3); Adam's running means of each as `first_NAME` and `second_NAME`;
    `gradients` (n,) and `seen` (n,), the sums by which splats are made.
    """

    late: int

    def take_views(self, views: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> None:
        """Keep pictures (h, w, 3) uint8 with their masks (h, w) bool, to be compared with."""
        ...

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Hold these splats from now on; arrays that are not given stay as they are."""
        ...

    def store(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """The splats as they are now; `names`: of the arrays that are wanted."""
        ...

    def pick(self, rows: np.ndarray, kept: int) -> None:
        """Hold the splats `rows` (m,) uint32 of those that there are, with nothing remembered of those from
        `kept` on."""
        ...

    def write(self, arrays: Mapping[str, np.ndarray], first: int) -> None:
        """Other values in the last rows of these arrays, from row `first` on."""
        ...

    def clear(self, names: Sequence[str]) -> None:
        """Zeros in these arrays."""
        ...

    def resident(self, degree: int, origin: np.ndarray) -> ResidentData:
        """The splats as they are drawn, with SH of this degree; it changes as they do."""
        ...

    def loss(
        self, images: Any, view: int, dssim_weight: float
    ) -> tuple[Callable[[], tuple[float, float]], Any]:
        """Compare a picture with that of a view, by its number: what waits for the loss and the mean squared
        difference, to be called before `late` more pictures, and the loss's derivative (h, w, 3) as an array
        of the device, which holds until the next call."""
        ...

    def surface(self, images: Any, view: int, camera: Camera, weight: float) -> dict[str, Any]:
        """Derivatives by `depth` and `normal` of `fidsplat.train.losses.normal_loss`, times its weight; as
        arrays of the device, which hold until the next call."""
        ...

    def count(self, taken: Any, camera: Camera, origin: np.ndarray) -> None:
        """Add derivatives by places on the screen to their sums, and who was seen by the camera.

        taken: what `TrainedPipeline.take_back` gave.
        """
        ...

    def step(
        self,
        taken: Any,
        sizes: Mapping[str, float],
        numbers: Mapping[str, float],
        camera: Camera | None,
        origin: np.ndarray,
    ) -> None:
        """A step of Adam by what `TrainedPipeline.take_back` gave.

        Args:
            sizes: of the step, by `means`, `scales`, `quats`, `logits`, `sh` (of degree 0), `rest`.
            numbers: `beta1`, `beta2`, `epsilon`, `root` (of 1 - beta2^step); `scale_penalty` and
                `opacity_penalty`, added to the derivatives; `sparse`: 1 where splats rest that the picture
                does not depend on.
            camera: counts first, as `count` does, unless None.
        """
        ...

    def shake(self, size: float, steep: float, clear: float, words: Sequence[int]) -> None:
        """Move means at random within their disks by `size` times their variance, those less whose opacity is
        above `clear`. words: the seed's low and high word, the iteration, the purpose."""
        ...


@runtime_checkable
class Trains(Protocol):
    """A backend that has kernels for training."""

    def training(self) -> TrainingKernels:
        """They, compiled, without splats.

        Raises:
            DeviceError: the compiler refuses.
        """
        ...


@runtime_checkable
class CompilesAhead(Protocol):
    """A backend that compiles in the background."""

    def compile_ahead(self, features: FeatureSet) -> None:
        """Begin to compile what `differentiate` gives for these features, which then waits for it. An error
        is that of `differentiate`."""
        ...


@runtime_checkable
class Differentiates(Backend, Protocol):
    """A backend that has derivatives of its pictures."""

    def differentiate(self, features: FeatureSet) -> DifferentiablePipeline:
        """The pipeline for these features with its derivatives, compiled on first use.

        Raises:
            InputError: an effect has no gradient; the message names it and what would do.
            DeviceError: the compiler refuses.
        """
        ...
