"""Export of images to NumPy, torch, JAX, CuPy and Warp by the array protocols."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.util.errors import InputError


class ArrayExport(Mapping[str, np.ndarray]):
    """Images by name that other array libraries can read: `__array__`, `__dlpack__`, `to_torch`."""

    outputs: tuple[str, ...]
    _noun: str
    """name of the class in messages"""

    def device_array(self, name: str) -> Any:
        """The images on their device, without a copy."""
        raise NotImplementedError

    def _check(self, name: str) -> None:
        """Raise MissingOutputError for an output that was not requested."""
        raise NotImplementedError

    def _is_shared(self, name: str) -> bool:
        """Whether the device shares an array of these images."""
        raise NotImplementedError

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
            raise InputError("to_torch needs torch, which is not installed; pip install torch") from None
        if self._is_shared(name):
            return torch.from_dlpack(self.device_array(name))
        return torch.from_numpy(self[name].copy())  # torch has no read-only tensors

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The images of the only output, for NumPy, PIL and OpenCV.

        Raises:
            InputError: several outputs.
        """
        image = self[self._only_output()]
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
        """The images of the only output as an array that exports DLPack."""
        name = self._only_output()
        if self._is_shared(name):
            return self.device_array(name)
        return self[name].copy()  # NumPy exports no read-only arrays by DLPack

    def _only_output(self) -> str:
        """The name of the only output."""
        if len(self.outputs) != 1:
            raise InputError(
                f"the {self._noun} must have one output, got {len(self.outputs)} ({', '.join(self.outputs)});"
                f" take one by its name, for example {self._noun}['rgb']"
            )
        return self.outputs[0]


def host_array(what: str, value: Any) -> Any:
    """An array of another library on the host, as a NumPy array on the same memory (DLPack). Other values are
    returned as they are.

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
