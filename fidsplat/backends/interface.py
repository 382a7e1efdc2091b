"""The interface of a device: base classes with defaults for optional capabilities.

`Backend.traits` says what a device offers. Code outside a backend never depends on its name.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.probing import Probe
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.effects import FeatureSet, declared_output
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import DeviceError, InputError


@dataclass(frozen=True)
class DeviceInfo:
    """Description of a device."""

    name: str
    """Value of `device=` that opens this device."""
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
    always_float64: bool = False
    """whether it computes everything in float64: slow, and the reference for other devices"""


@dataclass(frozen=True)
class DeviceTraits:
    """Optional capabilities of a device."""

    caches_chunks: bool = False
    """`Backend.chunk_cache`"""
    termination_depths: bool = False
    """`Backend.termination_depths` and `copy_tiles`, and kernels for the effect `termination_depths`"""
    differentiates: bool = False
    """`Backend.differentiate`"""
    trains: bool = False
    """`Backend.training`"""
    measures_rates: bool = False
    """`Backend.rates`, `memory_bytes` and `release_scratch`, and kernels for the effect `overdraw`"""
    probed: bool = False
    """`Backend.probe`, `shapes` and `pieces`, for tests"""


@dataclass(frozen=True)
class Rates:
    """Measured peak rates of a device, per second."""

    copy_bytes: float
    """bytes read and bytes written by a copy, together"""
    fma: float
    """float32 multiply-adds"""
    exp: float
    """float32 exponentials, as in the blend stage"""
    division: float
    """float32 divisions, as in the blend stage"""


class ResidentData(ABC):
    """A cloud on a device, with the `CloudTraits`."""

    count: int
    """splats"""
    origin: np.ndarray
    """(3,) float64 metres: world position of the means' zero"""
    memory_bytes: int
    """device memory that it takes; 0 where the device reads the host's own arrays"""
    sh_degree: int
    has_coplanar_groups: bool
    footprint: str
    ellipsoids: str

    def color_range(self) -> tuple[float, float]:
        """Lower and upper bound of every channel of every splat, from any direction."""
        raise InputError(
            "the output 'error' must be of splats whose colours are known, got a cloud without them; render "
            "a SplatCloud, or leave the output out"
        )


@dataclass(frozen=True, eq=False)
class Chunk:
    """Consecutive splats of a scene."""

    key: Hashable
    """the same for the same splats, wherever they are placed"""
    count: int
    load: Callable[[], Mapping[str, np.ndarray]]
    """their arrays by the names of a cloud's, float32 or int32; `coplanar_groups` by dense
    indices"""
    pose: np.ndarray | None = None
    """(16,) float64: placement, the rotation by rows, the position of the means' zero [m], and the
    quaternion; None: not moved"""
    first: int = 0
    """row of those arrays at which its `count` splats start"""


class ChunkedScene(ABC):
    """A scene divided into chunks, with the `CloudTraits` of all of it."""

    origin: np.ndarray
    """(3,) float64 metres: world position of the means' zero"""
    sh_degree: int
    has_coplanar_groups: bool
    footprint: str
    ellipsoids: str

    @abstractmethod
    def distinct(self, applies_poses: bool) -> int:
        """Number of keys of its chunks. applies_poses: whether the device applies `Chunk.pose`."""


class ChunkCache(ABC):
    """Device cache of a scene's chunks, bounded by the memory budget; the least recently used are evicted."""

    applies_poses: bool
    """whether the device applies `Chunk.pose`; else it must be None"""
    memory_bytes: int
    """device memory that it takes"""

    @abstractmethod
    def gather(self, chunks: Sequence[Chunk], first_id: int = 0) -> ResidentData:
        """Concatenate chunks on the device, loading those that are not cached. first_id: `splat_id` of the
        first splat."""

    @abstractmethod
    def prefetch(self, chunks: Sequence[Chunk]) -> None:
        """Prefetch chunks of the next frame while one is rendered, as far as capacity allows. Called from
        another thread."""


class Images(ABC):
    """Output images of one or several views, on the device until they are read.

    Views that are masked out hold `Output.blank`.
    """

    views: int = 1
    """with those that are masked out"""
    timings: Mapping[str, float]
    """milliseconds on the device by stage, in their order; of several views the sums"""
    stats: Mapping[str, int]
    """splats of the cloud; visible and pairs, of several views the sums"""
    shares_arrays: bool = False
    """whether arrays of `device_array` can be exchanged by DLPack"""

    @abstractmethod
    def read(self, name: str, index: int | None = None) -> np.ndarray:
        """Copy images to the host, in the type of `OUTPUTS[name]`: (views, h, w) or (views, h, w, channels);
        with an index the image of this view, (h, w) or (h, w, channels)."""

    def read_float64(self, name: str, index: int | None = None) -> np.ndarray:
        """Copy images to the host in float64, not rounded where they were computed so."""
        return self.read(name, index).astype(np.float64)

    def read_uint8(self, name: str, index: int = 0) -> np.ndarray | None:
        """Copy an image of floats in [0, 1] to the host in 8 bits, converted by the device with the bits of
        `to_uint8` (fidsplat/images/files.py); None where the device does not convert."""
        return None

    def empty(self, name: str) -> np.ndarray:
        """A host array for the image of one view."""
        return np.empty_like(self.read(name, 0))

    def read_rows(self, name: str, first: int, end: int, into: np.ndarray, index: int = 0) -> None:
        """Copy pixel rows [first, end) of a view to the same rows of an array of the image's shape."""
        if first < end:
            into[first:end] = self.read(name, index)[first:end]

    def device_array(self, name: str, index: int | None = None) -> Any:
        """The images as an array of the device, in the shape of `read`; no copy."""
        raise InputError(
            f"device_array({name!r}) needs a device that shares its arrays, as Warp devices do; "
            "render with device='warp:cuda' or 'warp:cpu', or take frame[name], which is copied to the host"
        )

    def wait(self) -> None:  # noqa: B027 (optional)
        """Wait until the device has rendered them."""


class HostImages(Images):
    """Images in host memory."""

    def __init__(
        self, arrays: Mapping[str, np.ndarray], timings: Mapping[str, float], stats: Mapping[str, int]
    ) -> None:
        """arrays: (views, ...) by the names of outputs."""
        self.arrays, self.timings, self.stats = arrays, timings, stats
        self.views = len(next(iter(arrays.values())))

    def arrays_of(self, index: int) -> dict[str, np.ndarray]:
        """The arrays of one view."""
        return {name: images[index] for name, images in self.arrays.items()}

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        return self.read_float64(name, index).astype(declared_output(name).dtype)

    def read_float64(self, name: str, index: int | None = None) -> np.ndarray:
        """The arrays as they were computed; integers too."""
        return self.arrays[name] if index is None else self.arrays[name][index]


class SeparateImages(Images):
    """Images of views that were rendered one after another."""

    def __init__(self, images: Mapping[int, Images], batch: ViewBatch, splats: int) -> None:
        """images: of the views that were rendered, by their position in the batch. splats: in the cloud."""
        self._images, self.views, self._size, self._splats = images, batch.total, batch.size, splats

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        output = declared_output(name)
        if index is not None and index in self._images:
            return self._images[index].read(name, 0)
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        if index is not None:
            return np.full(shape, output.blank, output.dtype)
        made = np.full((self.views, *shape), output.blank, output.dtype)
        for number, images in self._images.items():
            made[number] = images.read(name, 0)
        return made

    def wait(self) -> None:
        for images in self._images.values():
            images.wait()

    @property
    def timings(self) -> Mapping[str, float]:
        return summed(images.timings for images in self._images.values())

    @property
    def stats(self) -> Mapping[str, int]:
        none = {"splats": 0, "visible": 0, "pairs": 0}
        return summed([none, *(images.stats for images in self._images.values())]) | {"splats": self._splats}


def summed(counts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Sums of mappings from names to numbers."""
    sums: dict[str, Any] = {}
    for each in counts:
        for name, value in each.items():
            sums[name] = sums.get(name, 0) + value
    return sums


class Pipeline(ABC):
    """The stages compiled for one FeatureSet."""

    @abstractmethod
    def render_view(self, resident: Any, view: View) -> Images:
        """Render one view of an uploaded cloud."""

    def render(self, resident: Any, views: ViewBatch) -> Images:
        """Render several views, each bit-identical to itself alone. By default one after another."""
        each = enumerate(views.batch_indices.tolist())
        rendered = {index: self.render_view(resident, views.one(number)) for number, index in each}
        return SeparateImages(rendered, views, resident.count)

    def fits(self, resident: Any, view: View) -> bool:
        """Whether the frame fits the memory budget without rendering the cloud in chunks."""
        return True

    def trace(self, resident: Any, view: View) -> dict[str, np.ndarray]:
        """Render one view and return the data between the stages, for tests; empty by default."""
        return {}


class GradientPipeline(ABC):
    """The stages and their derivatives, compiled for one FeatureSet."""

    @abstractmethod
    def forward(self, resident: Any, view: View, waits: bool = True) -> Any:
        """Render one view of an uploaded cloud, bit-identical to `Pipeline.render`, and retain what
        `backward` needs until the device renders another frame.

        waits: until it is known that the buffers were large enough. If they were not, `backward` may raise
        CapacityExceeded, and nothing of the frame counts.

        Raises:
            DeviceError: the device runs out of memory or fails; or the frame needs bands or chunks, which
                have no gradient.
        """

    @abstractmethod
    def backward(self, images: Any, gradients: Mapping[str, Any]) -> dict[str, Any]:
        """Gradients of a loss with respect to splats, background and pose, from those by output images.

        Steps (the alpha cut-off, the transmittance stop, the near plane, the order of splats) have no
        derivative: they are constants of the frame.

        Args:
            images: the result of the last `forward` on this device.
            gradients: by the names of outputs (rgb, alpha, depth, normal, distortion), float32 arrays of
                their shape, of the device or NumPy's; missing ones are 0.

        Returns:
            Device arrays in the cloud's shapes and units: `means` (n, 3), `quats` (n, 4), `scales` (n, 2),
            `opacities` (n,), `colors` (n, 3) or `sh` (n, k, 3), with respect to the stored values, also of
            quaternions that are not normalised; `screen` (n,), the norm of the gradient by the projected
            centre in units of half images (the densification statistic of 2DGS trainers, their dL_dmean2D);
            `background` (3,); `pose` (6,): rotation vector [1 / rad] and translation [1 / m] of a motion
            after world_to_camera, in the camera's axes. Splats that are not rendered have zeros. The arrays
            are bit-identical on every run and valid until the next call.

        Raises:
            CapacityExceeded: the buffers of a frame that was not waited for were too small; the next is
                given larger ones.
            InputError: another frame has been rendered since, or a gradient is of no output or has a wrong
                shape.
            DeviceError: the device runs out of memory or fails.
        """

    def backward_to_tiles(self, images: Any, gradients: Mapping[str, Any]) -> Any:
        """Gradients in the form that `TrainingKernels.step` of the device accepts; by default those of
        `backward`."""
        return self.backward(images, gradients)


class TrainingKernels(ABC):
    """The work of a training step around the frame (`fidsplat.train`), on device arrays.

    Its state is n splats before their activations, float32: `means` (n, 3), `log_scales` (n, 2), `quats`
    (n, 4), `logits` (n,), `sh` (n, k, 3); Adam's running means of each as `first_NAME` and `second_NAME`;
    `gradient_sums` (n,) and `visible_counts` (n,), the statistics of densification.
    """

    max_pending_losses: int
    """number of later frames after which a loss may still be read"""

    @abstractmethod
    def load_views(self, views: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> None:
        """Set the ground truth: images (h, w, 3) uint8 with their masks (h, w) bool."""

    @abstractmethod
    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Set these arrays; missing ones are unchanged."""

    @abstractmethod
    def read(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Copy the arrays of these names to the host, all by default."""

    @abstractmethod
    def gather_rows(self, rows: np.ndarray, remaining: int) -> None:
        """Replace the splats by the rows (m,) uint32 of them; from row `remaining` on without moments."""

    @abstractmethod
    def write(self, arrays: Mapping[str, np.ndarray], first: int) -> None:
        """Overwrite the last rows of these arrays, from row `first` on."""

    @abstractmethod
    def clear(self, names: Sequence[str]) -> None:
        """Fill these arrays with zeros."""

    @abstractmethod
    def resident(self, degree: int, origin: np.ndarray) -> ResidentData:
        """The splats as a cloud to render, with SH of this degree; it changes as they do."""

    @abstractmethod
    def loss(
        self, images: Any, view: int, dssim_weight: float
    ) -> tuple[Callable[[], tuple[float, float]], Any]:
        """Compare a frame with the ground truth of a view, by its number. Returns what waits for the loss and
        the mean squared difference, to be called before `late` more frames, and the gradient of the loss
        (h, w, 3) as a device array that is valid until the next call."""

    @abstractmethod
    def normal_loss_gradients(self, images: Any, view: int, camera: Camera, weight: float) -> dict[str, Any]:
        """Gradients of `fidsplat.train.losses.normal_loss` by `depth` and `normal`, times the weight, as
        device arrays that are valid until the next call."""

    @abstractmethod
    def accumulate_statistics(self, taken: Any, camera: Camera, origin: np.ndarray) -> None:
        """Add screen gradients and visibility to their sums. taken: from `backward_to_tiles`."""

    @abstractmethod
    def step(
        self,
        taken: Any,
        sizes: Mapping[str, float],
        numbers: Mapping[str, float],
        camera: Camera | None,
        origin: np.ndarray,
    ) -> None:
        """Apply a step of Adam.

        Args:
            taken: from `GradientPipeline.backward_to_tiles`.
            sizes: step sizes of `means`, `scales`, `quats`, `logits`, `sh` (degree 0) and `rest`.
            numbers: `beta1`, `beta2`, `epsilon`, `root` (of 1 - beta2^step); `scale_penalty` and
                `opacity_penalty`, added to the gradients; `sparse`: 1 where splats on which the frame does
                not depend are left unchanged.
            camera: unless None, `accumulate_statistics` comes first.
        """

    @abstractmethod
    def add_noise(self, size: float, slope: float, threshold: float, words: Sequence[int]) -> None:
        """Add noise to the means within their disks, `size` times their variance, less where the opacity is
        above `threshold`. words: the seed's low and high word, the iteration, the purpose."""


class Backend(ABC):
    """An open device."""

    info: DeviceInfo
    traits: DeviceTraits = DeviceTraits()
    shape: Any = None
    """build constants of its kernels: sizes of tiles, methods of sorting"""
    pair_budget: int = 2**30 - 1
    """maximum number of splat-tile pairs that are listed at once; tests lower it"""
    memory_bytes: int = 0
    """device memory of scratch buffers; clouds and finished images are not included"""

    def lacks(self, requirement: str, remedy: str) -> str:
        """Error message of an operation that the device does not offer."""
        return f"device must {requirement}, got {self.info.name}; {remedy}"

    @abstractmethod
    def upload(self, cloud: SplatCloud) -> ResidentData:
        """Copy a cloud to the device."""

    @abstractmethod
    def pipeline(self, features: FeatureSet, shape: Any = None) -> Pipeline:
        """The pipeline for these features, compiled on first use. shape: one of `shapes` instead of the
        device's own.

        Raises:
            DeviceError: what is `unsupported`; or the compiler fails.
        """

    def render_every(
        self,
        pipeline: Any,
        resident: Any,
        view: View,
        step: int,
        progress: Callable[[float], object] | None = None,
    ) -> Images:
        """Render every step-th pixel in both directions, starting with the first: images of
        (ceil(h / step), ceil(w / step)), bit-identical to those pixels of a complete frame. progress: called
        with the completed share, 0 to 1."""
        raise InputError(self.lacks("render subsets of pixels", "use device='reference', or render"))

    def unsupported(self, features: FeatureSet) -> str:
        """Error message naming the features that the device cannot render; empty if it renders all."""
        return ""

    def limit_memory(self, budget: int) -> None:
        """Limit the device memory of a frame and its cloud to `budget` bytes."""
        raise InputError(self.lacks("have a memory budget", f"leave out memory_budget={budget}"))

    def adopt(self, arrays: Mapping[str, Any], origin: np.ndarray) -> ResidentData:
        """A cloud of arrays (`means`, `quats`, ...) that are on the device, without a copy. Raises InputError
        for arrays that cannot be used."""
        raise InputError(self.lacks("adopt arrays", "use a Warp device, or a SplatCloud"))

    def chunk_cache(self, scene: ChunkedScene, rows: int) -> ChunkCache:
        """A cache of a scene's chunks, each of at most `rows` splats."""
        raise DeviceError(self.lacks("cache chunks of a scene", "upload the scene"))

    def termination_depths(self, images: Any) -> TerminationDepths:
        """Termination depth per tile of a frame with the effect `termination_depths`; waits for the frame."""
        raise DeviceError(self.lacks("report termination depths", "render without occlusion culling"))

    def copy_tiles(self, images: Any, other: Any, tiles: np.ndarray) -> None:
        """Copy tiles (rows, columns) bool of another frame of the same view into a frame, and add its counts.
        Pixels must not have samples in more than one tile."""
        raise DeviceError(self.lacks("copy tiles", "render without occlusion culling"))

    def differentiate(self, features: FeatureSet, shape: Any = None) -> GradientPipeline:
        """The pipeline for these features with its derivatives, compiled on first use.

        Raises:
            InputError: an effect has no gradient; the message names it and a remedy.
            DeviceError: the compiler fails.
        """
        raise DeviceError(self.lacks("have gradients", "use device='opencl', 'warp' or 'reference'"))

    def compile_in_background(self, features: FeatureSet) -> None:  # noqa: B027 (optional)
        """Start to compile `differentiate` of these features in the background, where the device can.
        `differentiate` waits for it and raises its errors."""

    def training(self) -> TrainingKernels:
        """Compiled training kernels, without splats. Raises DeviceError where the compiler fails."""
        raise DeviceError(self.lacks("have kernels for training", "train in NumPy"))

    def release_scratch(self) -> None:
        """Release the scratch buffers, so that the next frame allocates only what it needs."""
        raise DeviceError(self.lacks("measure its memory", "use an OpenCL device"))

    def rates(self) -> Rates:
        """Peak rates of the device, measured at each call."""
        raise DeviceError(self.lacks("measure its rates", "use an OpenCL device"))

    def probe(self) -> Probe:
        """Access to the device for tests."""
        raise DeviceError(self.lacks("have a probe", "use an OpenCL or Warp device"))

    def shapes(self, kind: str) -> dict[str, Any]:
        """Other build constants, by name, for tests.

        kind: `tiles`, other tile sizes, bit-identical; `schedule`, the schedule of a GPU (on a GPU: other
        tiles), equal but for rounding; `listing`, the tile-binning strategies under the schedule of a GPU
        where the device has several; `sorting`, all methods of binning and sorting; `arithmetic`, ways of
        compiling the functions of `Probe.arithmetic`: fused or not, in vectors or one by one; `k_buffer`,
        smaller k-buffers, bit-identical; `tape`, fewer fragments stored for the backward pass, with
        bit-identical gradients.
        """
        return {}

    def pieces(self, shape: Any) -> int:
        """Number of pieces into which sorts divide their input."""
        return 1
