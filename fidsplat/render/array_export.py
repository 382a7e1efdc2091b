"""Images by name: copies on the host, and export to torch, JAX, CuPy and Warp by array protocols."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from fidsplat.backends.interface import Images
from fidsplat.util.errors import InputError, MissingOutputError

if TYPE_CHECKING:
    from fidsplat.render.certified_error import ErrorImage

SceneIndices = Callable[[], np.ndarray] | None
"""function that returns the scene index, (n,) int32, of each splat of a cloud that is assembled from chunks
of a store (a scene on disk); None: the cloud is the complete scene"""


class ImageMapping(Mapping[str, np.ndarray]):
    """Output images by name, as read-only NumPy arrays that are copied from the device on first use.

    Other array libraries read them by `__array__`, `__dlpack__` and `to_torch`.
    """

    _noun: str
    """name of the class in messages"""
    _error: ErrorImage | None = None
    """the output `error`, if it is requested"""

    def __init__(
        self, images: Images, outputs: tuple[str, ...], scene_indices: SceneIndices, index: int | None = None
    ) -> None:
        """scene_indices: for `splat_id`. index: position of the view in `images`; None: all views."""
        self._images, self._pid, self._scene_indices, self._index = images, os.getpid(), scene_indices, index
        self._arrays: dict[str, np.ndarray] = {}
        self.outputs = outputs
        """Names of the images, in the requested order."""

    def __getitem__(self, name: str) -> np.ndarray:
        self._check(name)
        if name not in self._arrays:
            check_process(self._pid, self._noun)
            computed = self._error if name == "error" else None
            image = self._images.read(name, self._index) if computed is None else computed.read()
            self._arrays[name] = image = with_scene_indices(name, image, self._scene_indices)
            image.flags.writeable = False  # cached
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.outputs)

    def __len__(self) -> int:
        return len(self.outputs)

    def device_array(self, name: str) -> Any:
        """The image on its device, without a copy.

        Warp: a wp.array, (h, w) or (h, w, 3); for a batch (views, h, w) or (views, h, w, 3). OpenCL: a
        pyopencl.array.Array, for batches only; a frame raises InputError.

        The array belongs to this frame or batch; later frames do not overwrite it. `wp.to_torch`, DLPack and
        `__cuda_array_interface__` convert it to a tensor on the same device.

        Raises:
            InputError: an output that was not requested, or the backend shares no arrays.
        """
        self._check(name)
        check_process(self._pid, self._noun)
        if self._is_computed(name):
            what = "splat_id of a store" if name == "splat_id" else f"the output {name!r}"
            raise InputError(f"{what} must be read on the host, got device_array; use {self._noun}[{name!r}]")
        return self._images.device_array(name, self._index)

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, summed over all views: project, sort, bin, blend, resolve,
        and accumulate (shutters); of gradients reserve (OpenCL), blend backward and project backward;
        `error`: all stages of the second image that the output `error` renders. The device `reference` has
        one stage, `reference`.

        On a GPU, most frames replay a recorded command list, and are rendered again to measure these times,
        since timing each launch would slow down all frames. Empty if the frame's cloud has been released.
        """
        return self._images.timings

    @property
    def stats(self) -> Mapping[str, int]:
        """Numbers of splats in the cloud, of visible (not culled) splats, and of (splat, tile) pairs, summed
        over views."""
        return self._images.stats

    def wait(self) -> Self:
        """Wait until the device has rendered the images; nothing is copied.

        Raises:
            DeviceError: the device has failed during rendering.
        """
        self._images.wait()
        return self

    def _check(self, name: str) -> None:
        """Raise MissingOutputError for an output that was not requested."""
        if not isinstance(name, str) or name not in self.outputs:
            raise MissingOutputError(
                f"an output of this {self._noun} must be one of {', '.join(self.outputs)}, got {name!r}; add "
                "it to `outputs` when you render"
            )

    def _is_computed(self, name: str) -> bool:
        """Whether an image is computed on the host, so that the device has no array of it."""
        return name == "error" or (name == "splat_id" and self._scene_indices is not None)

    def _is_shared(self, name: str) -> bool:
        return self._images.shares_arrays and not self._is_computed(name)

    def to_torch(self, name: str = "rgb") -> Any:
        """The images as a torch tensor: on their device without a copy if the backend shares arrays
        (`device_array`), else copied to the host.

        Raises:
            InputError: an output that was not requested, or torch is not installed.
        """
        self._check(name)
        try:
            import torch  # type: ignore[import-not-found]
        except ImportError:
            raise InputError("torch must be installed for to_torch, got none; pip install torch") from None
        if self._is_shared(name):
            return torch.from_dlpack(self.device_array(name))
        return torch.from_numpy(self[name].copy())  # torch has no read-only tensors

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The images of the only output, for NumPy, PIL and OpenCV.

        Raises:
            InputError: several outputs, or `copy=False` with another dtype.
        """
        image = self[self._only_output()]
        if copy is False and dtype and dtype != image.dtype:
            raise InputError(f"dtype must be {image.dtype} with copy=False, got {dtype}; omit copy=False")
        return image.astype(dtype or image.dtype) if copy or (dtype and dtype != image.dtype) else image

    def __dlpack__(self, **options: Any) -> Any:
        """The images of the only output, for `from_dlpack` of torch, CuPy, JAX, Warp and NumPy.

        They are not copied if the backend shares arrays; otherwise they are copied to the host.

        Raises:
            InputError: several outputs.
        """
        return self._exported().__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        """DLPack's device type and id of the images."""
        return self._exported().__dlpack_device__()

    def _exported(self) -> Any:
        """An array that exports DLPack, of the only output."""
        name = self._only_output()
        if self._is_shared(name):
            return self.device_array(name)
        return self[name].copy()  # DLPack before 1.0 has no read-only arrays

    def _only_output(self) -> str:
        """Name of the only output. Raises InputError for several outputs."""
        if len(self.outputs) != 1:
            raise InputError(
                f"the {self._noun} must have one output, got {len(self.outputs)} ({', '.join(self.outputs)});"
                f" access one by its name, for example {self._noun}['rgb']"
            )
        return self.outputs[0]


def with_scene_indices(name: str, image: np.ndarray, scene_indices: SceneIndices) -> np.ndarray:
    """Replace device indices by scene indices in `splat_id`, except -1; other outputs are unchanged."""
    if name != "splat_id" or scene_indices is None:
        return image
    return np.append(scene_indices(), np.int32(-1))[image]


def check_process(opened_by: int, what: str) -> None:
    """Raise InputError if this process is a fork of `opened_by`, since drivers do not work after a fork."""
    if opened_by != os.getpid():
        raise InputError(
            f"this {what} must be used in the process that opened it ({opened_by}), got a fork of it; open a "
            "Renderer in each process, and read frames before the fork"
        )


def host_array(what: str, value: Any) -> Any:
    """Convert an array of another library on the host to a NumPy array that shares its memory (DLPack). Other
    values are returned unchanged.

    Raises:
        InputError: an array on another device, or one that requires gradients.
    """
    if isinstance(value, np.ndarray) or not hasattr(value, "__dlpack__"):
        return value
    try:
        return np.from_dlpack(value)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(
            f"{what} must be on the host, or on the device of a Warp renderer, and detached, got {error}"
        ) from None
