"""The error of a device's own arithmetic, in units of the last place (ulp), over the ranges that rendering
uses: the library's functions, and our own short ones (`Quality.arithmetic`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.base import Probed
from fidsplat.hard_cases.case import Finding
from fidsplat.random_clouds import log_uniform
from fidsplat.render import Renderer

_COUNT = 1 << 18
# in ulp: what OpenCL C 1.2 (section 7.4) promises of each function, and of the short ones what they keep for
# all arguments with and without a fused multiply-add (tools/fast_bounds.py)
BOUNDS = {
    "exp": 3.0,
    "log": 3.0,
    "division": 2.5,
    "sqrt": 3.0,
    "fma": 0.5,
    "division64": 0.5,
    "sqrt64": 0.5,
    "log64": 3.0,
    "fast_exp": 2.3,
    "fast_log": 1.1,
}


@dataclass(frozen=True)
class Arithmetic:
    """What was measured on one device."""

    float64: bool
    """whether it has float64, for the per-splat set-up"""
    denormals: bool
    """whether it keeps float32 numbers below 1.2e-38"""
    ulp: dict[str, float]
    """largest error of each function of `BOUNDS` that the device has"""

    @property
    def findings(self) -> list[Finding]:
        """Each function against its bound, with room for the rounding of the truth itself."""
        return [Finding(f"{name} [ulp]", ulp, BOUNDS[name] * 1.001) for name, ulp in self.ulp.items()]


def measure(renderer: Renderer, seed: int = 0) -> Arithmetic | None:
    """Measure a device on a quarter of a million arguments of each function; None for one that runs no
    functions alone, as the reference.

    exp of -14 to 0 (1e-6, the least cut-off of a preset, to 1), log of 2^-24 to 1 (transmittances), quotients
    of 1e-9 to 1e9 by the same, roots of the same.

    Raises:
        DeviceError: the device cannot compile or run the kernels.
    """
    backend = renderer.backend
    if not isinstance(backend, Probed):
        return None
    generator = np.random.default_rng(seed)
    exponents = generator.uniform(-14, 0, _COUNT).astype(np.float32).astype(float)
    shares = log_uniform(generator, 2.0**-24, 1.0, _COUNT).astype(np.float32).astype(float)
    above, below = (
        log_uniform(generator, 1e-9, 1e9, _COUNT).astype(np.float32).astype(float) for _ in range(2)
    )
    got = backend.probe().arithmetic(exponents, shares, above, below)
    wide_above, wide_below = above.astype(np.longdouble), below.astype(np.longdouble)
    truth = {
        "exp": np.exp(exponents),
        "log": np.log(shares),
        "division": above / below,
        "sqrt": np.sqrt(below),
        "fma": above * below + above,
        "division64": wide_above / wide_below,
        "sqrt64": np.sqrt(wide_below),
        "log64": np.log(wide_below),
        "fast_exp": np.exp(exponents),
        "fast_log": np.log(shares),
    }
    ulp = {name: worst(got[name], truth[name]) for name in truth if name in got}
    kept = bool(got["denormal"][0] > 0 and got["denormal"][1] == np.finfo(np.float32).tiny)
    return Arithmetic(renderer.device.float64, kept, ulp)


def worst(got: np.ndarray, truth: np.ndarray) -> float:
    """Largest error of `got` in ulp of its own type, both (n,); infinite where one is not finite."""
    spacing = np.spacing(np.abs(truth).astype(got.dtype))
    # not np.max of the errors alone: a NaN must not be lost
    errors = np.abs(got - truth) / spacing
    return float(errors.max()) if np.isfinite(errors).all() else float("inf")
