"""Code shared by backends with gradients: differentiable images, and checks of gradient arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.interface import Images
from fidsplat.backends.view import View
from fidsplat.effects import IMAGES
from fidsplat.util.errors import InputError

NOT_LATEST_FRAME = (
    "backward must be called before the next frame of the device, got images of an earlier frame; "
    "render again"
)


class CapacityExceeded(Exception):
    """Raised if a frame that was submitted before its number of (splat, tile) pairs was known has more pairs
    than its buffers hold."""


class DifferentiableImages:
    """Output images, with the frame's data on the device that `backward` needs."""

    frame: Any
    images: Images

    def __init__(self, frame: Any, images: Images) -> None:
        self.frame, self.images = frame, images
        self._number = frame.workspace.frames

    @property
    def is_latest(self) -> bool:
        """Whether this is the device's latest frame, so that `backward` is possible."""
        return self.frame.workspace.frames == self._number

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        return self.images.read(name, index)

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds by stage, including the stages of `backward`."""
        return self.images.timings

    @property
    def stats(self) -> Mapping[str, int]:
        """Number of splats, of visible splats, and of (splat, tile) pairs."""
        return self.images.stats


def gradient_shape(name: str, view: View) -> tuple[int, ...]:
    """Shape of the gradient with respect to an output, equal to the shape of its image: frames with gradients
    have one sample per pixel."""
    channels = IMAGES[name].channels
    return (view.height, view.width) if channels == 1 else (view.height, view.width, channels)


def check_shape(name: str, given: tuple[int, ...], view: View) -> None:
    """Raise InputError unless the gradient with respect to an output has the shape of the image."""
    if tuple(given) != gradient_shape(name, view):
        raise InputError(
            f"the gradient of {name} must have the shape {gradient_shape(name, view)}, got {tuple(given)}"
        )


def on_host(array: Any) -> np.ndarray:
    """Copy a device array to a float32 NumPy array that later frames do not overwrite."""
    if hasattr(array, "get"):
        return np.asarray(array.get(), np.float32)
    if hasattr(array, "numpy"):  # on the CPU, numpy() of a wp.array shares its memory
        return np.array(array.numpy(), np.float32)
    return np.asarray(array, np.float32)
