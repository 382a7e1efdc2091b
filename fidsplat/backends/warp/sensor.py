"""The sensor's steps on a Warp device: one more kernel after resolving (kernels/warp/sensor.py)."""

from __future__ import annotations

from typing import Any

from fidsplat.backends.view import View
from fidsplat.backends.warp.runtime import kernels
from fidsplat.backends.warp.workspace import ArrayPool


class SensorKernel:
    """The kernel of some steps, and what it reads."""

    def __init__(self, steps: tuple[str, ...]) -> None:
        self._steps = [kernels("post").declared(name) for name in steps]
        self.kernel, self._settings = kernels("sensor").make_sensor(steps)

    def settings(self, view: View, pool: ArrayPool) -> Any:
        """The struct `Settings` of a view."""
        filled = self._settings()
        for step in self._steps:
            numbers = [number for name in step.uniforms for number in view.uniform(name)]
            for field, number in zip(step.numbers, numbers, strict=True):
                setattr(filled, field, number)
            for name, dtype in step.arrays.items():
                setattr(filled, name, pool.filled(name, view.array(name), dtype))
        return filled
