"""Optimised kernels, as users compile them, are bit-identical with those of other tests, which are compiled
with little optimisation (tests/optimisation.py)."""

import hashlib
import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from combined import LENSES, all_effects, combination
from optimisation import as_users_compile, level

import fidsplat as fs
from fidsplat.selftest.catalogue import all_cases
from fidsplat.selftest.check import run_case

LENS = "fisheye"
FRAMES = {
    "base": {"base": ()},
    LENS: {LENS: all_effects(LENS)},
    "the others": {str(lens): all_effects(lens) for lens in (None, *LENSES) if lens != LENS},
}
"""effects of each frame: none, and all with every lens"""
DEVICES = [
    info.name for info in fs.devices() if info.usable and info.kind == "cpu" and info.name != "reference"
]
ARGUMENTS = np.random.default_rng(3).uniform(1e-6, 80.0, 1 << 16).astype(np.float32).astype(float)


def digest(images):
    """Digest of named arrays."""
    ordered = (np.ascontiguousarray(images[name]).tobytes() for name in sorted(images))
    return hashlib.sha256(b"".join(ordered)).hexdigest()


def rendered(renderer, names):
    """Digest of the images of a combination."""
    requested = combination(names)
    frame = renderer.render(requested.cloud, requested.capture)
    return digest({name: frame[name] for name in requested.capture.outputs})


def digests_of(device, frames):
    """Level of optimisation, and digests of the frames and fast functions. Checks the cases of group F that
    depend on the compiler."""
    renderer = fs.Renderer(device)
    digests = {title: rendered(renderer, names) for title, names in FRAMES[frames].items()}
    functions = renderer.backend.probe().arithmetic(-ARGUMENTS, ARGUMENTS / 80.0, ARGUMENTS, ARGUMENTS[::-1])
    digests["functions"] = digest({name: functions[name] for name in ("fast_exp", "fast_log", "fma")})
    wrong = [run_case(renderer, case)[0].wrong for case in all_cases("F") if case.name in ("F1", "F2", "F3")]
    assert wrong == [[], [], []]
    return level(), digests


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("frames", ["base", LENS, pytest.param("the others", marks=pytest.mark.exhaustive)])
def test_optimised_kernels_are_bit_identical(device, frames):
    """A run has the plain frame on one device and the frame with all effects on the other."""
    if level() == "as users have it":
        pytest.skip("all tests run optimised kernels")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        with as_users_compile():
            optimised = pool.submit(digests_of, device, frames)
        here, digests = digests_of(device, frames)
        there, of_users = optimised.result()
    assert here == "hardly"
    assert there == "as users have it"
    assert of_users == digests
    assert len(set(digests.values())) == len(digests)
