"""Sweeps, of which plain pytest runs a sample and `pytest -m exhaustive` the rest."""

from collections.abc import Mapping, Sequence
from itertools import product
from zlib import crc32

import numpy as np
import pytest

SAMPLES = {"1 sample": 1, "2 x 2 samples": 2}
"""samples along a pixel's side, for `alternate`"""
TURN: int | None = None
"""the option `--turn`, 0 to 7, whose bits choose devices, pixels and cases; None: sweeps are complete"""
SWEEP = 4
WITHOUT_KERNELS = "tests/unit/", "tests/experiments/"


def sampled(cases: Sequence, count: int, seed: int) -> list:
    """All cases as parameters; all but `count` of them, chosen by chance, are marked `exhaustive`."""
    chosen = set(
        np.random.default_rng(seed).choice(len(cases), min(count, len(cases)), replace=False).tolist()
    )
    rest = pytest.mark.exhaustive
    return [pytest.param(case, marks=() if k in chosen else rest) for k, case in enumerate(cases)]


def alternate(*axes: Mapping[str, object]) -> list:
    """All combinations of the axes' values as parameters; every other one, as the fields of a chessboard, is
    marked `exhaustive`. A plain run has each value of an axis with some values of each other axis."""
    cases = []
    for picked in product(*(list(axis) for axis in axes)):
        places = [list(axis).index(name) for axis, name in zip(axes, picked, strict=True)]
        values = [axis[name] for axis, name in zip(axes, picked, strict=True)]
        rest = pytest.mark.exhaustive if sum(places) % 2 else ()
        cases.append(pytest.param(*values, id="-".join(picked), marks=rest))
    return cases


def chessboard(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows and columns of every other pixel of an image (h, w), as the fields of a chessboard of one colour,
    the other one two turns later. None, for all pixels, in complete sweeps."""
    if TURN is None:
        return None
    rows, columns = np.indices(size)
    return np.nonzero((rows + columns + TURN // 2) % 2 == 0)


def take_turns(items: Sequence[pytest.Item], devices: Sequence[str], turn: int = 0) -> None:
    """Mark tests `exhaustive` that another run has, of the 8 that differ in `turn`.

    A file's tests of several of these devices run on one of them, which then compiles a feature set for the
    complete file. Of `SWEEP` or more cases of a test of kernels, or with the mark `sweep`, every other one
    runs; with the mark and fewer cases the test runs in every other run.
    """
    results: dict[str, dict[str, list[pytest.Item]]] = {}
    for item in items:
        params = getattr(getattr(item, "callspec", None), "params", {})
        device = params.get("renderer", params.get("device"))
        marked = item.get_closest_marker("sweep")
        if (params or marked) and not item.get_closest_marker("exhaustive"):
            test = item.nodeid.partition("[")[0]
            results.setdefault(test, {}).setdefault(device if device in devices else "", []).append(item)
    for test, by_device in results.items():
        # a hash of the file's name, so that its device does not depend on which other tests are collected
        own = devices[(crc32(test.partition("::")[0].encode()) + turn) % len(devices)] if devices else ""
        for device, cases in by_device.items():
            elsewhere = own in by_device and device not in ("", own)
            marked, long = cases[0].get_closest_marker("sweep"), len(cases) >= SWEEP
            sweep = marked or (long and not test.startswith(WITHOUT_KERNELS))
            place = turn // 4 + (0 if long else crc32(test.encode()))
            for number, item in enumerate(cases):
                # the parity of the number's bits: of two short axes, no run has one value of one axis only
                if elsewhere or (sweep and (long * number.bit_count() + place) % 2):
                    item.add_marker(pytest.mark.exhaustive)
