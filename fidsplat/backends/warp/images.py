"""Finished output images on a Warp device."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.warp.launch import Launcher
from fidsplat.effects import Output


class WarpImages:
    """The output images of one picture, on the device until asked for."""

    def __init__(
        self,
        images: dict[str, tuple[Output, Any]],
        size: tuple[int, int],
        launcher: Launcher,
        stats: dict[str, int],
    ) -> None:
        self._images, self._size, self._launcher = images, size, launcher
        self.stats: Mapping[str, int] = stats

    def device_array(self, name: str) -> Any:
        """The image as a wp.array (h, w) or (h, w, 3) on the device; no copy."""
        output, array = self._images[name]
        return array.reshape(self._size if output.channels == 1 else (*self._size, output.channels))

    def read(self, name: str) -> np.ndarray:
        """The image as a NumPy array of its own."""
        # a CPU array's numpy() is its own memory, which device_array gives away
        return np.array(self.device_array(name).numpy())

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds on the device by stage, in the order in which they ran."""
        return self._launcher.timings()
