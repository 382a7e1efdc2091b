"""Finished planes on a Warp device."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.backends.warp.launch import Launcher
from fidsplat.effects.catalogue import Output


class WarpPlanes:
    """Finished planes on the device."""

    def __init__(
        self,
        outputs: dict[str, tuple[Output, Any]],
        size: tuple[int, int],
        launcher: Launcher,
        stats: dict[str, int],
    ) -> None:
        self._outputs, self._size, self._launcher = outputs, size, launcher
        self.stats: Mapping[str, int] = stats

    def device_array(self, name: str) -> Any:
        """The plane as a wp.array (h, w) or (h, w, 3) on the device; no copy."""
        output, array = self._outputs[name]
        return array.reshape(self._size if output.channels == 1 else (*self._size, output.channels))

    def read(self, name: str) -> np.ndarray:
        # a CPU array's numpy() is its own memory, which device_array gives away
        return np.array(self.device_array(name).numpy())

    @property
    def timings(self) -> dict[str, float]:
        return self._launcher.timings()
