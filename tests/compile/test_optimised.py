"""Kernels as users have them, optimised: other tests draw with kernels that hardly are
(tests/optimisation.py), and those of users have the same bits."""

import hashlib
import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from combined import LENSES, combination, everything
from optimisation import as_users_compile, level

import fidsplat as fs
from fidsplat.selftest.catalogue import all_cases
from fidsplat.selftest.check import run_case

LENS = "fisheye"
PICTURES = {
    "one lens": {"base": (), LENS: everything(LENS)},
    "the others": {str(lens): everything(lens) for lens in (None, *LENSES) if lens != LENS},
}
"""what is switched on in each picture: all behind every lens, which takes a device 5 to 10 s of compiling"""
DEVICES = [
    info.name for info in fs.devices() if info.usable and info.kind == "cpu" and info.name != "reference"
]
ARGUMENTS = np.random.default_rng(3).uniform(1e-6, 80.0, 1 << 16).astype(np.float32).astype(float)


def digest(images):
    """Of arrays by name."""
    ordered = (np.ascontiguousarray(images[name]).tobytes() for name in sorted(images))
    return hashlib.sha256(b"".join(ordered)).hexdigest()


def drawn(renderer, names):
    """The digest of a combination's images."""
    asked = combination(names)
    frame = renderer.render(asked.cloud, asked.capture)
    return digest({name: frame[name] for name in asked.capture.outputs})


def found(device, pictures):
    """The level of optimisation, and digests by what they are of: pictures, and short functions. The cases
    of the catalogue that ask what a compiler makes of arithmetic hold."""
    renderer = fs.Renderer(device)
    digests = {title: drawn(renderer, names) for title, names in PICTURES[pictures].items()}
    functions = renderer.backend.probe().arithmetic(-ARGUMENTS, ARGUMENTS / 80.0, ARGUMENTS, ARGUMENTS[::-1])
    digests["functions"] = digest({name: functions[name] for name in ("fast_exp", "fast_log", "fma")})
    wrong = [run_case(renderer, case)[0].wrong for case in all_cases("F") if case.name in ("F1", "F2", "F3")]
    assert wrong == [[], [], []]
    return level(), digests


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("pictures", ["one lens", pytest.param("the others", marks=pytest.mark.exhaustive)])
def test_what_users_have_draws_the_same_bits(device, pictures):
    if level() == "as users have it":
        pytest.skip("all tests run what users have")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        with as_users_compile():
            optimised = pool.submit(found, device, pictures)
        here, digests = found(device, pictures)
        there, of_users = optimised.result()
    assert here == "hardly"
    assert there == "as users have it"
    assert of_users == digests
    assert len(set(digests.values())) == len(digests)
