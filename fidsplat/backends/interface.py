"""Interface of a device: base classes whose optional methods return a default or raise an error."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.backends.alignment import AlignmentKernels
from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.probing import Probe
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet, declared_output
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.properties import CloudLike
from fidsplat.util.errors import DeviceError, InputError, bytes_words


@dataclass(frozen=True)
class DeviceInfo:
    """Description of a device."""

    name: str
    """value of `device=` that opens this device"""
    title: str
    """name of the device in its driver"""
    platform: str
    """name of the OpenCL platform, or of the library that renders"""
    version: str
    """version of the driver or library"""
    kind: str
    """`cpu`, `gpu` or `other`"""
    compute_units: int
    memory_bytes: int
    largest_allocation_bytes: int
    float64: bool
    usable: bool
    reason: str
    """why the device cannot be used; for a usable device, a remark (may be empty)"""
    always_float64: bool = False
    """whether the device is the reference renderer, which computes everything in float64"""


@dataclass(frozen=True)
class Rates:
    """Measured peak rates of a device, per second."""

    copy_bytes: float
    """bytes read plus bytes written by a copy"""
    fma: float
    """float32 multiply-adds"""
    exp: float
    """float32 exponentials, as in the blend stage"""
    division: float
    """float32 divisions, as in the blend stage"""


class DeviceCloud(ABC):
    """A cloud on a device, with the properties that select its kernels (splats/properties.py)."""

    count: int
    origin: np.ndarray
    """(3,) float64 metres: world position of the means' zero"""
    memory_bytes: int
    """bytes on the device; 0 if the device reads the host's arrays"""
    sh_degree: int
    has_coplanar_groups: bool
    footprint: str
    """`gaussian`, `box` or `mixed`"""
    ellipsoids: str
    """which splats are 3D Gaussians: `none`, `some` or `all`"""

    def copy_properties(self, cloud: CloudLike) -> None:
        """Copy the origin and the properties that select kernels from another cloud."""
        for name in ("origin", "sh_degree", "has_coplanar_groups", "footprint", "ellipsoids"):
            setattr(self, name, getattr(cloud, name))

    def color_range(self) -> tuple[float, float]:
        """Lower and upper bound of every channel of every splat, from any direction."""
        raise InputError(
            "the splats must have a known range of colours for the output 'error', got splats on a device "
            "that does not compute it; use another device, or leave out 'error'"
        )


@dataclass(frozen=True, eq=False)
class Chunk:
    """Consecutive splats of a scene."""

    key: Hashable
    """cache key: equal for chunks with the same splats, even if their poses differ"""
    count: int
    load: Callable[[], Mapping[str, np.ndarray]]
    """function that returns the splats' arrays, float32 or int32, named as in SplatCloud"""
    pose: np.ndarray | None = None
    """(16,) float64: rotation matrix by rows, translation [m], rotation as a quaternion; None: identity"""
    first: int = 0
    """first row of the chunk in the arrays of `load`"""


class Images(ABC):
    """Output images of one or several views, on the device until they are read. Views that are masked out
    have the value `Output.empty_value`."""

    view_count: int = 1
    """number of views, including masked-out views"""
    timings: Mapping[str, float]
    """milliseconds on the device by stage, in the order of the stages; summed over views"""
    stats: Mapping[str, int]
    """number of splats of the cloud; of visible splats and of (splat, tile) pairs, summed over views"""
    shares_arrays: bool = False
    """whether the arrays of `device_array` support DLPack"""

    @abstractmethod
    def read(self, name: str, index: int | None = None) -> np.ndarray:
        """Copy images to the host, in the type of `declared_output(name)`: (views, h, w) or
        (views, h, w, channels), or one view without the first axis if `index` is given."""

    def read_float64(self, name: str, index: int | None = None) -> np.ndarray:
        """Copy images to the host in float64; unrounded if the device computes in float64."""
        return self.read(name, index).astype(np.float64)

    def read_uint8(self, name: str, index: int = 0) -> np.ndarray | None:
        """Convert an image of floats in [0, 1] to 8 bits on the device, rounded like `images.files.to_uint8`,
        and copy it to the host; None if the device cannot."""
        return None

    def empty(self, name: str) -> np.ndarray:
        """A host array of the shape and type of one view's image, with undefined contents."""
        return np.empty_like(self.read(name, 0))

    def read_rows(self, name: str, first: int, end: int, into: np.ndarray, index: int = 0) -> None:
        """Copy pixel rows [first, end) of a view to the same rows of an array of the image's shape."""
        if first < end:
            into[first:end] = self.read(name, index)[first:end]

    def device_array(self, name: str, index: int | None = None) -> Any:
        """The images as a device array in the shape of `read`, without a copy."""
        raise InputError(
            f"device_array({name!r}) must be called for images of a device that shares its arrays, got "
            f"{type(self).__name__}; "
            f"render with device='warp:cuda' or 'warp:cpu', or copy to the host with frame[{name!r}]"
        )

    def wait(self) -> None:  # noqa: B027 (optional)
        """Wait until the device has rendered the images."""


class HostImages(Images):
    """Images in host memory."""

    def __init__(
        self, arrays: Mapping[str, np.ndarray], timings: Mapping[str, float], stats: Mapping[str, int]
    ) -> None:
        """arrays: (views, ...) by the names of outputs."""
        self.arrays, self.timings, self.stats = arrays, timings, stats
        self.view_count = len(next(iter(arrays.values())))

    def arrays_of(self, index: int) -> dict[str, np.ndarray]:
        """The arrays of one view."""
        return {name: images[index] for name, images in self.arrays.items()}

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        return self.read_float64(name, index).astype(declared_output(name).dtype)

    def read_float64(self, name: str, index: int | None = None) -> np.ndarray:
        """The arrays in their own type, float64 or integers."""
        return self.arrays[name] if index is None else self.arrays[name][index]


class SeparateImages(Images):
    """Images of views that were rendered one after another."""

    def __init__(self, images: Mapping[int, Images], batch: ViewBatch, splats: int) -> None:
        """images: by position of the view in the batch. splats: number of splats of the cloud."""
        self._images, self.view_count, self._size, self._splats = images, batch.total, batch.size, splats

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        output = declared_output(name)
        if index is not None and index in self._images:
            return self._images[index].read(name, 0)
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        if index is not None:
            return np.full(shape, output.empty_value, output.dtype)
        stack = np.full((self.view_count, *shape), output.empty_value, output.dtype)
        for number, images in self._images.items():
            stack[number] = images.read(name, 0)
        return stack

    def wait(self) -> None:
        for images in self._images.values():
            images.wait()

    @property
    def timings(self) -> Mapping[str, float]:
        return summed(images.timings for images in self._images.values())

    @property
    def stats(self) -> Mapping[str, int]:
        return batch_stats((images.stats for images in self._images.values()), self._splats)


def check_batch_memory(view_count: int, size: int, budget: int) -> None:
    """Raise DeviceError if the images of a batch exceed the memory budget."""
    if size > budget:
        raise DeviceError(
            f"the images of {view_count} views must be at most {bytes_words(budget)}, the memory budget, got "
            f"{bytes_words(size)}; render fewer views or outputs at once"
        )


def batch_stats(view_stats: Iterable[Mapping[str, int]], splats: int) -> dict[str, int]:
    """Number of splats of the cloud, and of visible splats and (splat, tile) pairs, summed over views."""
    return summed([{"visible": 0, "pairs": 0}, *view_stats]) | {"splats": splats}


def summed(mappings: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Add up mappings from names to numbers, name by name."""
    sums: dict[str, Any] = {}
    for mapping in mappings:
        for name, value in mapping.items():
            sums[name] = sums.get(name, 0) + value
    return sums


class Pipeline(ABC):
    """The stages compiled for one FeatureSet."""

    @abstractmethod
    def render_view(self, cloud: Any, view: View) -> Images:
        """Render one view of an uploaded cloud."""

    def render(self, cloud: Any, batch: ViewBatch) -> Images:
        """Render several views, each bit-identical to rendering it alone. By default one after another."""
        images = {
            index: self.render_view(cloud, batch.view_at(number))
            for number, index in enumerate(batch.batch_indices.tolist())
        }
        return SeparateImages(images, batch, cloud.count)

    def render_subsampled(
        self, cloud: Any, view: View, step: int, progress: Callable[[float], object] | None = None
    ) -> Images:
        """Render every step-th pixel in both directions, from the first: (ceil(h / step), ceil(w / step))
        images, bit-identical to those pixels of a complete frame. progress: called with the completed
        fraction, 0 to 1."""
        raise NotImplementedError

    def fits(self, cloud: Any, view: View) -> bool:
        """Whether the frame fits the memory budget without projecting the cloud in slices."""
        return True

    def render_intermediates(self, cloud: Any, view: View) -> dict[str, np.ndarray]:
        """Render one view; returns the buffers between the stages, for tests. Empty by default."""
        return {}


class GradientPipeline(ABC):
    """The stages and their gradients, compiled for one FeatureSet."""

    @abstractmethod
    def forward(self, cloud: Any, view: View, waits: bool = True) -> Any:
        """Render one view of an uploaded cloud, bit-identical to `Pipeline.render`, for a later `backward`.

        Args:
            waits: whether to wait until the number of (splat, tile) pairs shows that the buffers were large
                enough. With False, `backward` may raise CapacityExceeded; the frame must then be discarded.

        Raises:
            DeviceError: the frame does not fit the memory budget in one piece; a frame that is rendered in
                ranges of tiles or projected in slices has no gradient.
        """

    @abstractmethod
    def backward(self, images: Any, gradients: Mapping[str, Any]) -> dict[str, Any]:
        """Gradients of a loss with respect to splats, background and camera.

        Alpha cut-off, transmittance stop, near plane and depth order are treated as constants.

        Args:
            images: the result of the last `forward` on this device.
            gradients: gradients of the loss with respect to the outputs (rgb, alpha, depth, normal,
                distortion), float32 device or NumPy arrays in the shapes of the images; missing ones are 0.

        Returns:
            Device arrays, bit-identical on every run and valid until the next call: `means` (n, 3), `quats`
            (n, 4), `scales` (n, 2), `thickness` (n,) if the cloud has it, `opacities` (n,), `colors` (n, 3)
            or `sh` (n, k, 3); `grad2d` (n,), the norm of the gradient with respect to the projected centre in
            units of half images, at constant depth (dL_dmean2D of 2DGS trainers); `background` (3,); `pose`
            (6,), rotation vector [1 / rad] and translation [1 / m] of a motion after world_to_camera, in
            camera axes; `intrinsics` (4,): fx, fy, cx, cy [1 / px]. Culled splats have zeros.

        Raises:
            CapacityExceeded: `forward` did not wait, and the buffers were too small; the next frame has
                larger ones.
            InputError: the device has rendered another frame since, or a gradient has an unknown name or
                another shape.
        """

    def backward_per_tile(self, images: Any, gradients: Mapping[str, Any]) -> Any:
        """Gradients summed per tile, before the backward pass of the projection: the input of
        `Backend.training().step`. By default the result of `backward`."""
        return self.backward(images, gradients)


class Backend(ABC):
    """An open device."""

    info: DeviceInfo
    config: Any = None
    """build constants of the kernels, such as the tile size"""
    renders_subsampled: bool = False
    """whether pipelines implement `Pipeline.render_subsampled`"""
    pair_budget: int = 2**30 - 1
    """maximum number of (splat, tile) pairs in the tile lists at once; tests lower it"""
    memory_bytes: int = 0
    """device memory of scratch buffers and of buffers of released images, without clouds and images in
    use"""

    def has(self, method: str) -> bool:
        """Whether the device implements an optional method, for example `probe`."""
        return getattr(type(self), method) is not getattr(Backend, method)

    def unsupported_message(self, requirement: str, remedy: str) -> str:
        """Error message for an operation that the device does not support."""
        return f"device must {requirement}, got {self.info.name}; {remedy}"

    @abstractmethod
    def upload(self, cloud: SplatCloud) -> DeviceCloud:
        """Copy a cloud to the device."""

    @abstractmethod
    def pipeline(self, features: FeatureSet, config: Any = None) -> Pipeline:
        """The pipeline for these features, compiled on first use. config: build constants, one of `configs`;
        None: those of the device. Raises DeviceError if the device lacks a feature or the compiler fails."""

    def frame_config(self, view: View, count: int = 1) -> Any:
        """The `config` for which `pipeline` renders `count` views of this size fastest."""
        return None

    def unsupported(self, features: FeatureSet) -> str:
        """Error message naming the features that the device cannot render; empty if it renders all."""
        return ""

    def limit_memory(self, budget: int) -> None:
        """Limit the device memory of a frame and its cloud to `budget` bytes."""
        raise InputError(
            self.unsupported_message("have a memory budget", f"leave out memory_budget={budget}")
        )

    def wrap_arrays(self, arrays: Mapping[str, Any], origin: np.ndarray) -> DeviceCloud:
        """Use arrays that are already on the device (`means`, `quats`, ...) as a cloud, without a copy."""
        raise InputError(self.unsupported_message("wrap arrays", "use a Warp device, or a SplatCloud"))

    def chunk_cache(self, chunks: Any) -> Any:
        """A device cache for the chunks of a scene, a `streaming.device_chunks.DeviceChunks`."""
        raise DeviceError(self.unsupported_message("cache chunks of a scene", "upload the scene"))

    def termination_depths(self, images: Any) -> TerminationDepths:
        """Depth at which blending of each tile stopped, of a frame with the effect `termination_depths`."""
        raise DeviceError(
            self.unsupported_message("report termination depths", "render without occlusion culling")
        )

    def copy_tiles(self, images: Any, other: Any, tiles: np.ndarray) -> None:
        """Copy the tiles of a mask (rows, columns) bool from another frame of the same view into a frame, and
        add its `stats`. The sides of a tile must be multiples of the samples per pixel."""
        raise DeviceError(self.unsupported_message("copy tiles", "render without occlusion culling"))

    def gradient_pipeline(self, features: FeatureSet, config: Any = None) -> GradientPipeline:
        """The pipeline with gradients. Raises InputError for an effect without a gradient."""
        raise DeviceError(
            self.unsupported_message("have gradients", "use device='opencl', 'warp' or 'reference'")
        )

    def compile_in_background(self, features: FeatureSet, refined: bool = False) -> None:  # noqa: B027 (optional)
        """Start to compile the gradients of these features; `gradient_pipeline` waits for the
        compiler. refined: whether training steps refine views."""

    def training(self) -> Any:
        """The compiled kernels of a training step except rendering (`opencl.training.OpenCLTraining`)."""
        raise DeviceError(self.unsupported_message("have kernels for training", "train in NumPy"))

    def alignment(self) -> AlignmentKernels:
        """The compiled kernels of direct image alignment, shared by all callers."""
        raise DeviceError(self.unsupported_message("have kernels for image alignment", "align in NumPy"))

    def release_scratch(self) -> None:
        """Release the scratch buffers, so that the next frame allocates only what it needs."""
        raise DeviceError(self.unsupported_message("release its scratch buffers", "use an OpenCL device"))

    def rates(self) -> Rates:
        """Peak rates of the device, measured at each call."""
        raise DeviceError(self.unsupported_message("measure its rates", "use an OpenCL device"))

    def probe(self) -> Probe:
        raise DeviceError(
            self.unsupported_message("allow tests of its functions", "use an OpenCL or Warp device")
        )

    def configs(self, kind: str) -> dict[str, Any]:
        """Alternative build constants by name, with which tests compile the same features.

        Args:
            kind: what differs. With `tiles` and `k_buffer`, images are bit-identical.
                `tiles`, `k_buffer`: size of the tiles, of the k-buffer.
                `tape`: number of fragments that are stored for the backward pass.
                `binning`, `sorting`: method of tile binning, of sorting.
                `schedule`: work is assigned to threads as on a GPU.
                `arithmetic`: no fused multiply-adds, or no vectors.
        """
        return {}
