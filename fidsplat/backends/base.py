"""What every backend offers, and what only some do: typed protocols, by which others tell what a backend can.

Nobody outside a backend asks for its name: a capability is asked for with `isinstance(backend, Adopts)`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fidsplat.backends.stack import ViewBatch
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.effects import FeatureSet
from fidsplat.effects.select import Traits
from fidsplat.splats import SplatCloud


@dataclass(frozen=True)
class DeviceInfo:
    """One device that a backend sees."""

    name: str
    """What to pass as `device=` to get this one."""
    title: str
    platform: str
    version: str
    kind: str
    """cpu, gpu or other"""
    compute_units: int
    memory_bytes: int
    largest_allocation_bytes: int
    float64: bool
    usable: bool
    reason: str
    """Why it cannot be used; empty if it can. For a usable device, a remark (may be empty)."""


@dataclass(frozen=True)
class Rates:
    """What a device can do at best, measured: per second."""

    copy_bytes: float
    """bytes read and bytes written by a copy, together"""
    fma: float
    """float32 multiply-adds"""
    exp: float
    """float32 exponentials, as the blend stage calls them"""
    division: float
    """float32 divisions, as the blend stage writes them"""


class ResidentData(Traits, Protocol):
    """A cloud on a device."""

    @property
    def count(self) -> int:
        """Splats."""
        ...

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64 metres: the world's position of the means' zero."""
        ...

    @property
    def memory_bytes(self) -> int:
        """Device memory that it takes; 0 where the device reads the host's own arrays."""
        ...


class Images(Protocol):
    """Finished output images of one picture, on the device until asked for."""

    def read(self, name: str) -> np.ndarray:
        """The image as a NumPy array of its own, in the type of `OUTPUTS[name]`."""
        ...

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, in the order in which they ran."""
        ...

    @property
    def stats(self) -> Mapping[str, int]:
        """splats, visible, pairs."""
        ...


@runtime_checkable
class Waits(Protocol):
    """Images that may still be on their way."""

    def wait(self) -> None:
        """Until the device has drawn them."""
        ...


class BatchImages(Protocol):
    """Finished output images of many views."""

    @property
    def views(self) -> int:
        """How many, those that were masked out among them."""
        ...

    def read(self, name: str) -> np.ndarray:
        """The images as a NumPy array of its own, (views, h, w) or (views, h, w, channels), in the type of
        `OUTPUTS[name]`; where a view was masked out 0, or -1 in `label` and `splat_id`."""
        ...

    def read_one(self, name: str, number: int) -> np.ndarray:
        """The image of one view, as a NumPy array of its own."""
        ...

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, of all views together."""
        ...

    @property
    def stats(self) -> Mapping[str, int]:
        """splats in the cloud; visible and pairs of all views together."""
        ...


@runtime_checkable
class GivesArrays(Protocol):
    """Images that others on the device can use where they were drawn."""

    def device_array(self, name: str) -> Any:
        """The image as an array of the device, (h, w) or (h, w, channels), of a batch with the views before
        these; no copy."""
        ...


@runtime_checkable
class GivesFloat64(Protocol):
    """Images that were computed in float64 and still are."""

    def read_float64(self, name: str) -> np.ndarray:
        """The image as a NumPy array in float64."""
        ...


@runtime_checkable
class DrawsEvery(Protocol):
    """A pipeline that draws pixels one by one: it can leave some out, and say how far it is."""

    def render_every(
        self, cloud: Any, view: Any, step: int, tell: Callable[[float], object] | None = None
    ) -> Images:
        """Every step-th pixel in both directions, beginning with the first: images of (ceil(h / step),
        ceil(w / step)) with the bits that `render` gives those pixels. tell: called with the share that is
        done, 0 to 1."""
        ...


@runtime_checkable
class DrawsBatches(Protocol):
    """A pipeline that draws many views together."""

    def render_batch(self, resident: Any, batch: ViewBatch) -> BatchImages:
        """Draw many views of an uploaded cloud, each with the bits of itself alone."""
        ...


class Pipeline(Protocol):
    """The stages compiled for one FeatureSet."""

    def render(self, resident: Any, view: View) -> Images:
        """Draw one picture of an uploaded cloud."""
        ...

    def trace(self, resident: Any, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages, for tests."""
        ...


class Backend(Protocol):
    """An open device."""

    info: DeviceInfo
    always_float64: bool
    """whether every picture is computed in float64 throughout, whatever its quality asks for"""

    def limit_memory(self, budget: int) -> None:
        """Let a picture and its cloud take at most `budget` bytes of the device."""
        ...

    def upload(self, cloud: SplatCloud) -> ResidentData:
        """The cloud on the device."""
        ...

    def unsupported(self, features: FeatureSet) -> str:
        """What of these features the device cannot draw, as the message of the error that drawing them
        raises; empty if it can draw all."""
        ...

    def pipeline(self, features: FeatureSet) -> Pipeline:
        """The pipeline for these features, compiled on first use.

        Raises:
            DeviceError: what is `unsupported`; or the compiler refuses.
        """
        ...


@runtime_checkable
class Adopts(Protocol):
    """A backend that draws splats from arrays that are on the device already."""

    def adopt(self, arrays: Mapping[str, Any], origin: np.ndarray) -> ResidentData:
        """Arrays (`means`, `quats`, ...) used where they lie. Raises InputError for one that cannot be."""
        ...


@runtime_checkable
class Measurable(Protocol):
    """A backend that can be held against its hardware. It also has kernels for the effect `overdraw`."""

    @property
    def memory_bytes(self) -> int:
        """Device memory that scratch buffers hold; clouds and finished images are not among them."""
        ...

    def release_scratch(self) -> None:
        """Let go of them, so that the next picture shows what it needs."""
        ...

    def rates(self) -> Rates:
        """What the device can do at best; measured anew at each call."""
        ...


class Probe(Protocol):
    """Looks into an open device: small kernels compiled as the stages are, single stages on made-up input,
    and memory that is filled with rubbish first."""

    @property
    def fuses(self) -> bool:
        """Whether the device fuses multiply-adds where it is asked to."""
        ...

    def contraction(self, a: np.ndarray, b: np.ndarray) -> Sequence[np.ndarray]:
        """a b - a b; a b + a; the difference in the set-up's precision, of thirds; a b - (a b), fused: each
        (n,), from a, b (n,) float32."""
        ...

    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        """Of x (n,) float32: x != x, isnan, fails every comparison, isinf; each (n,) int32."""
        ...

    def arithmetic(
        self, exponents: np.ndarray, shares: np.ndarray, above: np.ndarray, below: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Results of the device's functions, float32 ones as the stages call them.

        Args:
            exponents, shares, above, below: (n,) float64, n a multiple of 16; they are rounded to float32
                where float32 is computed.

        Returns:
            (n,) float32: `exp` of exponents, `log` of shares, `division` above / below, `sqrt` of below,
            `fma` above * below + above, `fast_exp` of exponents, `fast_log` of shares; (n,) float64 where the
            device has it: `division64`, `sqrt64`, `log64`; `denormal` (2,) float32: half of the smallest
            normal number, and twice that.

        Raises:
            DeviceError: the device cannot compile or run the kernels.
        """
        ...

    def options(self) -> list[str]:
        """What every kernel is compiled with."""
        ...

    def scan(self, pipeline: Any, lengths: np.ndarray) -> tuple[np.ndarray, int]:
        """Where lists of these lengths (n,) uint32 start, modulo 2^32, (n + 1,) uint32; and the sum of all in
        64 bits."""
        ...

    def boxes(self, pipeline: Any, trace: Mapping[str, np.ndarray]) -> np.ndarray:
        """Of what `pipeline.trace` gave: the samples that each splat can touch, (n, 4) int, columns [x0, x1)
        and rows [y0, y1); undefined for culled splats."""
        ...

    def poisoned(self) -> AbstractContextManager[None]:
        """Within it, all memory that a picture takes is filled with 0xFF first: NaN, or the integer -1."""
        ...


@runtime_checkable
class Probed(Protocol):
    """A backend that lets tests look into its device."""

    pair_budget: int
    """most pairs of splats and tiles that are listed at once; tests make it small"""

    def probe(self) -> Probe:
        """What looks into it."""
        ...


@runtime_checkable
class Reshapes(Backend, Protocol):
    """A backend whose build constants (its "shape") tests may replace: sizes of tiles, ways of sorting."""

    shape: Any
    """the device's own"""

    def shapes(self, kind: str) -> dict[str, Any]:
        """Build constants by a name that people read. kind: `tiles`, of other sizes, whose pictures have the
        same bits; `schedule`, the way in which a GPU walks its tiles (on a GPU: other tiles), whose pictures
        agree but for rounding; `listing`, the ways of listing splats per tile, under the schedule of a GPU
        where the device has several; `sorting`, the device's own and others for listing and sorting;
        `arithmetic`, the ways of compiling the functions of `Probe.arithmetic`, fused or not, in vectors or
        one by one, the device's own among them; `waiting`, less room for fragments that wait for nearer ones,
        whose pictures have the same bits."""
        ...

    def pieces(self, shape: Any) -> int:
        """In how many pieces the sorts cut what they sort."""
        ...

    def pipeline(self, features: FeatureSet, shape: Any = None) -> Pipeline:
        """As `Backend.pipeline`, with build constants of `shapes`."""
        ...


class DifferentiablePipeline(Protocol):
    """The stages and their derivatives, compiled for one FeatureSet."""

    def forward(self, resident: Any, view: View) -> Images:
        """Draw one picture of an uploaded cloud, with the bits of `Pipeline.render`, and keep what `backward`
        needs of it until the device draws another one.

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
            gradients: by the names of outputs (rgb, alpha, depth, normal) float32 arrays of their shape, of
                the device or NumPy's; outputs that are missing have gradients of 0.

        Returns:
            Arrays of the device in the cloud's shapes and units: `means` (n, 3), `quats` (n, 4), `scales`
            (n, 2), `opacities` (n,), `colors` (n, 3) or `sh` (n, k, 3), by the values that the cloud has,
            quaternions of any length among them; `screen` (n,), the norm of the derivative by the projected
            centre in units of half pictures (the statistic by which 2DGS trainers densify, their
            dL_dmean2D); `background` (3,); `pose` (6,): rotation vector [1 / rad] and translation [1 / m] of
            a motion after world_to_camera, in the camera's axes. Splats that are not drawn have zeros. They
            are the same in every bit on every run, and hold until the next call.

        Raises:
            InputError: another picture has been drawn since, or a gradient is of no output or of a wrong
                shape.
            DeviceError: the device runs out of memory or fails.
        """
        ...


class TrainingKernels(Protocol):
    """The work of a training step around the picture (`fidsplat.train`), on arrays of the device.

    It holds splats before their activations, n of them, float32: `means` (n, 3), `log_scales` (n, 2), `quats`
    (n, 4), `logits` (n,), `sh` (n, k, 3); Adam's running means of each as `first_NAME` and `second_NAME`;
    `gradients` (n,) and `seen` (n,), the sums by which splats are made.
    """

    def take_views(self, views: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> None:
        """Keep pictures (h, w, 3) uint8 with their masks (h, w) bool, to be compared with."""
        ...

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Hold these splats from now on."""
        ...

    def store(self) -> dict[str, np.ndarray]:
        """The splats as they are now."""
        ...

    def resident(self, degree: int, origin: np.ndarray) -> ResidentData:
        """The splats as they are drawn, with SH of this degree; it changes as they do."""
        ...

    def loss(
        self, images: Any, view: int, dssim_weight: float
    ) -> tuple[Callable[[], tuple[float, float]], Any]:
        """Compare a picture with that of a view, by its number: what waits for the loss and the mean squared
        difference, to be called before the next picture, and the loss's derivative (h, w, 3) as an array of
        the device, which holds until the next call."""
        ...

    def surface(self, images: Any, view: int, camera: Camera, weight: float) -> dict[str, Any]:
        """Derivatives by `depth` and `normal` of `fidsplat.train.losses.normal_loss`, times its weight; as
        arrays of the device, which hold until the next call."""
        ...

    def count(self, screen: Any, camera: Camera, origin: np.ndarray) -> None:
        """Add derivatives (n,) by places on the screen to their sums, and who was seen."""
        ...

    def step(
        self, gradients: Mapping[str, Any], sizes: Mapping[str, float], numbers: Mapping[str, float]
    ) -> None:
        """A step of Adam by what `DifferentiablePipeline.backward` gave.

        Args:
            sizes: of the step, by `means`, `scales`, `quats`, `logits`, `sh` (of degree 0), `rest`.
            numbers: `beta1`, `beta2`, `epsilon`, `root` (of 1 - beta2^step); `scale_penalty` and
                `opacity_penalty`, added to the derivatives; `sparse`: 1 where splats rest that the picture
                does not depend on.
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
class Differentiates(Backend, Protocol):
    """A backend that has derivatives of its pictures."""

    def differentiate(self, features: FeatureSet) -> DifferentiablePipeline:
        """The pipeline for these features with its derivatives, compiled on first use.

        Raises:
            InputError: an effect has no gradient; the message names it and what would do.
            DeviceError: the compiler refuses.
        """
        ...
