"""Sweeps of which plain pytest takes a sample, and `pytest -m exhaustive` the rest."""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import pytest

SAMPLES = {"1 sample": 1, "2 x 2 samples": 2}
"""samples along a pixel's side, for `alternate`"""


def sampled(cases: Sequence, count: int, seed: int) -> list:
    """All cases as parameters; all but `count` of them, chosen by chance, are marked `exhaustive`."""
    kept = set(np.random.default_rng(seed).choice(len(cases), min(count, len(cases)), replace=False).tolist())
    rest = pytest.mark.exhaustive
    return [pytest.param(case, marks=() if k in kept else rest) for k, case in enumerate(cases)]


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


def in_turn(first: int = 0):
    """Marks a test whose first case runs on the processor's device number `first` (modulo their number), the
    next case on the next device, and so on; what this leaves out is `exhaustive`. GPUs run all cases."""
    return pytest.mark.in_turn(first)


def take_turns(items: Sequence[pytest.Item], devices: Sequence[str]) -> None:
    """Marks what `in_turn` leaves out of these tests. devices: the processor's."""
    cases: dict[str, dict[str, int]] = {}
    for item in items:
        mark, call = item.get_closest_marker("in_turn"), getattr(item, "callspec", None)
        if mark is None or call is None or item.get_closest_marker("exhaustive"):
            continue
        device = call.params.get("renderer")
        if device not in devices:
            continue
        seen = cases.setdefault(item.nodeid.partition("[")[0], {})
        turn = seen.setdefault(call.id.replace(device, "", 1), len(seen)) + mark.args[0]
        if turn % len(devices) != devices.index(device):
            item.add_marker(pytest.mark.exhaustive)
