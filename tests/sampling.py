"""Sweeps of which plain pytest takes a sample, and `pytest -m exhaustive` the rest."""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from fidsplat.cameras import Camera

LENSES = (None, "brown_conrady", "fisheye", "equirectangular", "orthographic")
"""kinds of lenses, numbered for `in_turn`: neighbours run on different devices"""
SAMPLES = {"1 sample": 1, "2 x 2 samples": 2}
"""samples along a pixel's side, for `alternate`"""
TURN: int | None = None
"""the option `--turn`; None: sweeps are complete"""


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


def in_turn(first: int = 0, by: Callable[[Any], int] | None = None):
    """Marks a test whose first case runs on the processor's device number `first` (modulo their number), the
    next case on the next device, and so on; what this leaves out is `exhaustive`. GPUs run all cases. Runs
    begin with different devices (`pytest --turn`), so a later run has the other pairs of case and device.

    by: number of a case instead of its position, `by_lens` or `by("samples")`: cases of one number run on one
    device, which compiles a feature set for all of them.
    """
    return pytest.mark.in_turn(first, by)


def by(name: str) -> Callable[[Any], int]:
    """Number of a case by the position of the value of a parameter."""
    return lambda call: call.indices[name]


def by_lens(call: Any, cameras: Mapping[str, Camera] = MappingProxyType({})) -> int:
    """Number of a case by the kind of the lens of its parameter `camera`, or `name`, a key of `cameras`."""
    camera = call.params["camera"] if "camera" in call.params else cameras.get(call.params["name"])
    lens = None if camera is None else camera.lens
    return LENSES.index(None if lens is None else lens.kind)


def chessboard(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows and columns of every other pixel of an image (h, w), as the fields of a chessboard of one colour,
    the other one with the other `TURN`. None, for all pixels, in complete sweeps."""
    if TURN is None:
        return None
    rows, columns = np.indices(size)
    return np.nonzero((rows + columns + TURN) % 2 == 0)


def take_turns(items: Sequence[pytest.Item], devices: Sequence[str], turn: int = 0) -> None:
    """Marks what `in_turn` leaves out of these tests. devices: the processor's; turn: number
    of the device that begins."""
    cases: dict[str, dict[str, int]] = {}
    for item in items:
        mark, call = item.get_closest_marker("in_turn"), getattr(item, "callspec", None)
        if mark is None or call is None or item.get_closest_marker("exhaustive"):
            continue
        device = call.params.get("renderer", call.params.get("device"))
        if device not in devices:
            continue
        first, number = mark.args
        seen = cases.setdefault(item.nodeid.partition("[")[0], {})
        place = number(call) if number else seen.setdefault(call.id.replace(device, "", 1), len(seen))
        if (place + first + turn) % len(devices) != devices.index(device):
            item.add_marker(pytest.mark.exhaustive)
