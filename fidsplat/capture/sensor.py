"""Sensor model: exposure, vignetting, noise, gain, response and quantisation."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.util.arguments import as_float, invalid, items, number, own_scalars, whole_number
from fidsplat.util.errors import InputError

RESPONSES = ("linear", "srgb")
BITS = (8, 16)
GAMMAS = 0.01, 100.0
"""range of gammas"""
LARGEST = 1e15
"""largest factor and curve value: results stay within float32"""


@dataclass(frozen=True)
class Sensor:
    """Sensor model of a camera. The values of a frame are linear light; the steps are applied in the order of
    the fields. A step with its default value costs nothing.

    Raises:
        InputError: a value is out of range.
    """

    exposure: float = 1.0
    """factor of the gathered light, at least 0"""
    vignetting: tuple[float, ...] = ()
    """up to three numbers a, b, c: light times 1 + a r^2 + b r^4 + c r^6, with r the distance from the
    principal point in half diagonals of the image"""
    full_well: float = math.inf
    """electrons at the value 1, at least 1: n electrons have a shot noise of sqrt(n); inf: no shot noise"""
    read_noise: float = 0.0
    """standard deviation of the read-out noise in electrons, 0 to full_well; requires full_well"""
    seed: int = 0
    """seed of the noise, 0 to 2^32 - 1; use another one for each frame"""
    gain: float = 1.0
    """factor after the read-out, at least 0"""
    response: str | float | tuple[float, ...] = "linear"
    """"linear"; "srgb", its transfer function; a gamma: v^(1 / gamma); or the curve's values at two or more
    even steps of v from 0 to 1. All but "linear" clamp v to [0, 1]."""
    bits: int | None = None
    """bits of quantisation and of the rgb file, 8 or 16; None: no quantisation"""
    extra_steps: tuple[str, ...] = ()
    """steps of other packages before quantisation, NAME or NAME:NUMBER,NUMBER (docs/effects.md)"""

    def __post_init__(self) -> None:
        own_scalars(self)
        if not as_float(self.full_well) >= 1:
            raise invalid("sensor: full_well", "a number of electrons, 1 or more", self.full_well)
        for name, highest in (("exposure", LARGEST), ("gain", LARGEST), ("read_noise", self.full_well)):
            number(f"sensor: {name}", getattr(self, name), f"a number from 0 to {highest:g}", 0, highest)
        if self.read_noise > 0 and math.isinf(self.full_well):
            raise InputError(f"sensor: full_well must be given with read_noise, got {self.read_noise!r} only")
        whole_number("sensor: seed", self.seed, 0, 2**32 - 1)
        if self.bits is not None and (not isinstance(self.bits, int) or self.bits not in BITS):
            raise invalid("sensor: bits", "8, 16 or None", self.bits)
        steps = items("sensor: extra_steps", self.extra_steps, str, "several texts, as ('negative:1',)")
        object.__setattr__(self, "extra_steps", tuple(steps))
        if len(self.extra) < len(steps):
            raise invalid("sensor: extra_steps", "different steps", steps)
        object.__setattr__(self, "vignetting", _numbers("vignetting", self.vignetting, 0, 3))
        if isinstance(self.response, str):
            if self.response not in RESPONSES:
                requirement = f"{', '.join(RESPONSES)}, a gamma above 0, or a table"
                raise invalid("sensor: response", requirement, self.response)
        elif not math.isnan(as_float(self.response)):
            number("sensor: a gamma", self.response, "from {:g} to {:g}".format(*GAMMAS), *GAMMAS)
        else:
            object.__setattr__(self, "response", _numbers("response", self.response, 2, 65536))

    @cached_property
    def extra(self) -> dict[str, tuple[float, ...]]:
        """Names of `extra_steps` with their numbers."""
        found = {}
        for text in self.extra_steps:
            name, colon, numbers = text.partition(":")
            found[name] = _numbers("extra_steps", map(float, numbers.split(",") if colon else ()), 0, 64)
        return found

    @cached_property
    def steps(self) -> tuple[str, ...]:
        """Names of the active steps, in order of application."""
        found = [
            ("exposure", self.exposure != 1),
            ("vignetting", any(self.vignetting)),
            ("noise", math.isfinite(self.full_well)),
            ("gain", self.gain != 1),
        ]
        if not isinstance(self.response, (str, tuple)):
            found.append(("response_gamma", self.response != 1))
        elif self.response == "srgb":
            found.append(("response_srgb", True))
        elif isinstance(self.response, tuple):
            # a line from 0 to 1 only clamps, which every output does as well
            line = np.linspace(0, 1, len(self.response))
            found.append(("response_table", not np.array_equal(self.response, line)))
        found += [(name, True) for name in self.extra]
        found.append(("quantise", self.bits is not None))
        return tuple(name for name, active in found if active)

    def uniform(self, name: str) -> tuple[Any, ...]:
        """Kernel arguments of a step, in order."""
        match name:
            case "noise":
                variance = 1 / self.full_well
                return variance, (self.read_noise * variance) ** 2, np.uint32(self.seed)
            case "vignetting":
                return (*self.vignetting, 0.0, 0.0, 0.0)[:3]
            case "inverse_gamma":
                return (1 / self.response,)  # type: ignore[operator]
            case "response_count":
                return (np.int32(len(self.response)),)  # type: ignore[arg-type]
            case "quantise_steps":
                return (2.0**self.bits - 1,)  # type: ignore[operator]
            case _ if name in self.extra:
                return self.extra[name]
            case _:
                return (getattr(self, name),)

    def changes(self) -> dict[str, Any]:
        """Values that differ from the default sensor, by name."""
        default = Sensor()
        pairs = ((f.name, getattr(self, f.name)) for f in fields(self))
        return {name: value for name, value in pairs if value != getattr(default, name)}


def _numbers(name: str, values: Any, lowest: int, highest: int) -> tuple[float, ...]:
    try:
        numbers = tuple(map(as_float, values))
    except (TypeError, ValueError):
        numbers = None
    if (
        numbers is None
        or not lowest <= len(numbers) <= highest
        or not all(abs(value) <= LARGEST for value in numbers)
    ):
        raise invalid(f"sensor: {name}", f"{lowest} to {highest} finite numbers up to {LARGEST:g}", values)
    return numbers
