"""Measure the error of the fast exponential and logarithm (`Quality.arithmetic`) over all arguments on a
device.

    python tools/fast_bounds.py [--device D] [--no-fma]     about a minute on two cores

Compares every float32 from -87 to -2^-26 for the exponential (it is 1 closer to 0), and every one from 2^-24
to 1 for the logarithm, with float64. The functions consist of sums and products, which all devices round
equally: the result holds for all devices with fused multiply-adds, or for all without them (--no-fma).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from itertools import zip_longest

import numpy as np
from rich.progress import track

import fidsplat as fs
from fidsplat.backends.opencl.device import OpenCLBackend
from fidsplat.selftest.arithmetic import worst

AT_ONCE = 1 << 22
EXPONENTS, SHARES = (2.0**-26, 87.0), (2.0**-24, 1.0)
NAMES = {"exp": np.exp, "fast_exp": np.exp, "log": np.log, "fast_log": np.log}


def every(low: float, high: float) -> Iterator[np.ndarray]:
    """Every float32 from low > 0 to high as float64, in arrays of `AT_ONCE`, the last one padded by
    `high`."""
    first, end = _bits(low, high)
    for start in range(first, end, AT_ONCE):
        bits = np.minimum(start + np.arange(AT_ONCE), end - 1).astype(np.uint32)
        yield bits.view(np.float32).astype(float)


def _bits(low: float, high: float) -> tuple[int, int]:
    first, last = np.array([low, high], np.float32).view(np.uint32)
    return int(first), int(last) + 1


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", help="see `fidsplat devices`")
    parser.add_argument(
        "--no-fma", action="store_true", help="emulate a device without fused multiply-adds (OpenCL)"
    )
    options = parser.parse_args()
    renderer = fs.Renderer(options.device)
    backend = renderer.backend
    if not backend.has("probe"):
        parser.error(f"--device must run single functions, got {renderer.device.name}; use an OpenCL device")
    if options.no_fma:
        if not isinstance(backend, OpenCLBackend):
            parser.error("--no-fma must be used with an OpenCL device")
        backend.config = replace(backend.config, fast_fma=False)
    most = dict.fromkeys(NAMES, 0.0)
    pairs = zip_longest(every(*EXPONENTS), every(*SHARES), fillvalue=np.ones(AT_ONCE))
    for x, share in track(pairs, "every float32", total=len(range(*_bits(*EXPONENTS), AT_ONCE))):
        got = backend.probe().arithmetic(-x, share, share, share)
        for name, function in NAMES.items():
            truth = function(share if name.endswith("log") else -x)
            most[name] = max(most[name], worst(got[name], truth))
    print(f"{renderer.device.title}, {renderer.device.version}{', without FMA' * options.no_fma}")
    for name, ulp in most.items():
        print(f"{name:10}{ulp:.3f} ulp")


if __name__ == "__main__":
    main()
