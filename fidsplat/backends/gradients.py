"""Shared by backends with derivatives: checks of gradients, and images with the frame that made them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.interface import Images
from fidsplat.backends.view import View
from fidsplat.effects import IMAGES
from fidsplat.util.errors import InputError

NOT_THE_LAST = (
    "backward must be called before the next frame of the device, got images of an earlier frame; "
    "render again"
)


class CapacityExceeded(Exception):
    """A frame was submitted without waiting for its counts, and exceeded the capacity of its lists."""


class DifferentiableImages:
    """Output images with the frame that made them, for `backward`."""

    frame: Any
    images: Images

    def __init__(self, frame: Any, images: Images) -> None:
        self.frame, self.images = frame, images
        self._number = frame.workspace.frames

    @property
    def last(self) -> bool:
        """Whether the device has started no other frame since."""
        return self.frame.workspace.frames == self._number

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        """Copy an image to the host, as `Images.read`."""
        return self.images.read(name, index)

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds by stage, including the stages of `backward`."""
        return self.images.timings

    @property
    def stats(self) -> Mapping[str, int]:
        """Numbers of splats, visible splats and pairs."""
        return self.images.stats


def gradient_shape(name: str, view: View) -> tuple[int, ...]:
    """The shape of an output's gradient, equal to that of its image."""
    channels = IMAGES[name].channels
    return (view.height, view.width) if channels == 1 else (view.height, view.width, channels)


def check_shape(name: str, given: tuple[int, ...], view: View) -> None:
    """Raise InputError unless a gradient has its output's shape."""
    if tuple(given) != gradient_shape(name, view):
        raise InputError(
            f"the gradient of {name} must have the shape {gradient_shape(name, view)}, got {tuple(given)}"
        )


def on_host(array: Any) -> np.ndarray:
    """A device array as a float32 NumPy array that later frames do not overwrite."""
    if hasattr(array, "get"):
        return np.asarray(array.get(), np.float32)
    if hasattr(array, "numpy"):  # of a wp.array on the CPU that is its own memory
        return np.array(array.numpy(), np.float32)
    return np.asarray(array, np.float32)
