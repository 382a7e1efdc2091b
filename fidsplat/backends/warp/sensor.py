"""The sensor's steps on a Warp device: one more kernel after resolving (kernels/warp/sensor.py)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fidsplat.backends.view import View
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.memory import ArrayPool
from fidsplat.effects.catalogue import CATALOGUE

STEPS = frozenset(
    {"exposure", "vignetting", "noise", "gain", "response_gamma", "response_srgb", "response_table"}
    | {"quantise"}
)
"""effects that change rgb pixel by pixel"""


@dataclass(frozen=True)
class Development:
    """The steps that a feature set has."""

    steps: tuple[str, ...]
    kernel: Any
    settings: Any
    """its first argument's type"""

    @classmethod
    def of(cls, posts: tuple[str, ...]) -> Development | None:
        """Of those of the posts that are a sensor's; None if there are none."""
        steps = tuple(name for name in posts if name in STEPS)
        return cls(steps, *runtime.kernels("sensor").make_develop(steps)) if steps else None

    def arguments(self, view: View, pool: ArrayPool) -> list[Any]:
        """The kernel's for a view: numbers, and the response's curve."""
        import warp as wp

        settings = self.settings()
        names = [name for step in self.steps for name in CATALOGUE[step].resolve_uniforms]
        numbers = [number for name in names for number in view.uniform(name)]
        known = runtime.kernels("sensor").NUMBERS
        fields = [field for step in self.steps for field in known[step]]
        for field, number in zip(fields, numbers, strict=True):
            setattr(settings, field, number)
        if "response_table" not in self.steps:
            return [settings, pool.scratch("no response", 1, wp.float32)]
        curve = wp.array(view.array("response"), dtype=wp.float32, device="cpu")
        response = pool.exact("response", curve.size, wp.float32)
        wp.copy(response, curve)
        return [settings, response]
