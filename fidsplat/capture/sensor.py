"""Sensor model: exposure, optics, noise, white balance, response and quantisation."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.util.arguments import as_float, invalid, items, number, python_scalars, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.response import linear_light

RESPONSES = ("linear", "srgb")
BITS = (8, 16)
GAMMA_RANGE = 0.01, 100.0
"""range of gammas"""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""weights of linear RGB in luminance (Rec. 709)"""
MAX_WHITE_BALANCE = 8.0
"""largest factor of a measured white balance"""
MAX_VALUE = 1e15
"""largest factor and curve value: results stay within float32"""


@dataclass(frozen=True)
class Sensor:
    """Sensor model of a camera. Values are linear light. A step with its default value is skipped.

    Order of the steps: decode, veiling_glare, exposure, vignetting, noise, saturation, gain, white_balance,
    response, extra_steps, bits.

    Raises:
        InputError: a value is out of range.
    """

    exposure: float = 1.0
    """factor of the incoming light, at least 0"""
    vignetting: tuple[float, ...] = ()
    """up to three coefficients a, b, c: light is multiplied by 1 + a r^2 + b r^4 + c r^6, with r the distance
    from the principal point in half diagonals of the image"""
    full_well: float = math.inf
    """electrons at value 1, at least 1: n electrons have a shot noise of sqrt(n); inf: no shot noise"""
    read_noise: float = 0.0
    """standard deviation of the read-out noise in electrons, 0 to full_well; requires full_well"""
    seed: int = 0
    """seed of the noise, 0 to 2^32 - 1; use a different one for each frame"""
    gain: float = 1.0
    """factor after the read-out, at least 0"""
    response: str | float | tuple[float, ...] = "linear"
    """"linear"; "srgb", its transfer function; a gamma: v^(1 / gamma); or a table of two or more values at
    equidistant v from 0 to 1. All except "linear" clamp v to [0, 1]."""
    bits: int | None = None
    """bits of quantisation and of the rgb file, 8 or 16; None: none"""
    extra_steps: tuple[str, ...] = ()
    """steps of other packages before quantisation, NAME or NAME:NUMBER,NUMBER (docs/effects.md)"""
    decode: str = "linear"
    """encoding of the frame's colours: "linear" light, or "srgb" display colours, which are decoded"""
    veiling_glare: float = 0.0
    """fraction of the light, 0 to below 1, that the lens scatters evenly over the image"""
    glare_light: tuple[float, ...] = ()
    """RGB of the scattered light; empty: the mean of the image, measured in a small frame"""
    auto_exposure: float = 0.0
    """target luminance of the mean of the image, e.g. 0.18, measured in a small frame; `exposure` is an
    additional factor. 0: off"""
    saturation: float = math.inf
    """largest registered value, above 0; before gain"""
    white_balance: str | tuple[float, ...] = (1.0, 1.0, 1.0)
    """factors of R, G and B; "grey": the factors that make the mean of the image grey, measured in a small
    frame"""

    def __post_init__(self) -> None:
        python_scalars(self)
        if not as_float(self.full_well) >= 1:
            raise invalid("sensor: full_well", "a number of electrons, 1 or more", self.full_well)
        for name, highest in (("exposure", MAX_VALUE), ("gain", MAX_VALUE), ("read_noise", self.full_well)):
            number(f"sensor: {name}", getattr(self, name), f"a number from 0 to {highest:g}", 0, highest)
        if self.read_noise > 0 and math.isinf(self.full_well):
            raise InputError(f"sensor: full_well must be given with read_noise, got {self.read_noise!r} only")
        whole_number("sensor: seed", self.seed, 0, 2**32 - 1)
        if self.decode not in RESPONSES:
            raise invalid("sensor: decode", " or ".join(RESPONSES), self.decode)
        number("sensor: veiling_glare", self.veiling_glare, "a number from 0 to 0.99", 0, 0.99)
        number("sensor: auto_exposure", self.auto_exposure, "a number from 0 to 1", 0, 1)
        if not as_float(self.saturation) > 0:
            raise invalid("sensor: saturation", "a number above 0", self.saturation)
        for name, counts in (("glare_light", (0, 3)), ("white_balance", (3,))):
            value = getattr(self, name)
            if isinstance(value, str) and name == "white_balance":
                if value != "grey":
                    raise invalid("sensor: white_balance", 'three numbers or "grey"', value)
                continue
            numbers = _numbers(name, value, counts[0], 3)
            if len(numbers) not in counts or min(numbers, default=0) < 0:
                raise invalid(f"sensor: {name}", "three numbers of at least 0", value)
            object.__setattr__(self, name, numbers)
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
            number("sensor: a gamma", self.response, "from {:g} to {:g}".format(*GAMMA_RANGE), *GAMMA_RANGE)
        else:
            object.__setattr__(self, "response", _numbers("response", self.response, 2, 65536))

    @cached_property
    def extra(self) -> dict[str, tuple[float, ...]]:
        """Numbers of `extra_steps` by name."""
        steps = {}
        for text in self.extra_steps:
            name, colon, numbers = text.partition(":")
            steps[name] = _numbers("extra_steps", map(float, numbers.split(",") if colon else ()), 0, 64)
        return steps

    @cached_property
    def steps(self) -> tuple[str, ...]:
        """Names of the active steps, in order of application."""
        steps = [
            ("decode_srgb", self.decode == "srgb"),
            ("veiling_glare", self.veiling_glare > 0),
            ("exposure", self.exposure != 1 or self.auto_exposure > 0),
            ("vignetting", any(self.vignetting)),
            ("noise", math.isfinite(self.full_well)),
            ("saturation", math.isfinite(self.saturation)),
            ("gain", self.gain != 1),
            ("white_balance", self.white_balance != (1.0, 1.0, 1.0)),
        ]
        if not isinstance(self.response, (str, tuple)):
            steps.append(("response_gamma", self.response != 1))
        elif self.response == "srgb":
            steps.append(("response_srgb", True))
        elif isinstance(self.response, tuple):
            # a table that is the identity only clamps, as every output does
            line = np.linspace(0, 1, len(self.response))
            steps.append(("response_table", not np.array_equal(self.response, line)))
        steps += [(name, True) for name in self.extra]
        steps.append(("quantise", self.bits is not None))
        return tuple(name for name, active in steps if active)

    @property
    def needs_metering(self) -> bool:
        """Whether exposure, white balance or glare must be measured in a small frame."""
        glare = self.veiling_glare > 0 and not self.glare_light
        return glare or self.auto_exposure > 0 or self.white_balance == "grey"

    def metered(self, colors: np.ndarray) -> Sensor:
        """The sensor with fixed exposure, white balance and glare, measured in an image (h, w, 3) that was
        rendered without a sensor."""
        if not self.needs_metering:
            return self
        mean = linear_light(colors, self.decode).reshape(-1, 3).mean(axis=0)
        glare = self.glare_light or tuple(mean.tolist())
        # scattering changes the mean only if glare_light is given
        mean = (1 - self.veiling_glare) * mean + self.veiling_glare * np.array(glare)
        luminance = max(float(mean @ LUMINANCE), 1 / MAX_VALUE)
        exposure = self.exposure * (self.auto_exposure / luminance if self.auto_exposure > 0 else 1.0)
        white_balance = self.white_balance
        if white_balance == "grey":
            white_balance = tuple((luminance / np.maximum(mean, luminance / MAX_WHITE_BALANCE)).tolist())
        changes = {"exposure": exposure, "auto_exposure": 0.0, "white_balance": white_balance}
        return replace(self, glare_light=glare if self.veiling_glare > 0 else (), **changes)

    def uniforms_of(self, name: str) -> tuple[Any, ...]:
        """Kernel arguments of a step, in order."""
        match name:
            case "noise":
                variance = 1 / self.full_well
                return variance, (self.read_noise * variance) ** 2, np.uint32(self.seed)
            case "vignetting":
                return (*self.vignetting, 0.0, 0.0, 0.0)[:3]
            case "veiling_glare":
                return 1 - self.veiling_glare, *(self.veiling_glare * light for light in self.glare_light)
            case "white_balance":
                return tuple(self.white_balance)
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

    def non_default(self) -> dict[str, Any]:
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
        or not all(abs(value) <= MAX_VALUE for value in numbers)
    ):
        counts = highest if lowest == highest else f"{lowest} to {highest}"
        raise invalid(f"sensor: {name}", f"{counts} finite numbers up to {MAX_VALUE:g}", values)
    return numbers
