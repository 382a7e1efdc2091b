"""The inputs of hostile.py: a function for each kind, which makes one from a random generator and has fidsplat
use it. It returns a command's exit status, or None."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from random import Random
from typing import Any

import hostile_files as files
import numpy as np
from hostile_files import LONG, NUMBERS, TEXTS

import fidsplat as fs
from fidsplat import cli

JUNK: list[Any] = [
    None, True, False, 0, -1, 1, 5, 2**31, 2**70, -(2**70), 10**400, 0.5, -0.0, 1e-320, 1e308, float("nan"),
    float("inf"), -float("inf"), "", "a", "rgb", "nan", "../..", "\0", "\ud800", "\n", "𝕏", LONG, b"", b"\xff", 1j,
    [], [1], [1, 2, 3], [[1], [2, 3]], ["a", "b", "c"], [None], [float("nan")] * 3, [1e300] * 3, (), (0, 0, 0), {},
    {1: 2}, {"rgb": 1}, {1, 2, 3}, object(), lambda *_: None, iter(()), range(3), ..., Decimal("1e999"),
    Fraction(1, 3), Path("nowhere"), slice(None), np.float32("nan"), np.int64(-5), np.bool_(True), np.array(3.0),
    np.array("text"), np.array([None]), np.zeros((0, 3)), np.zeros((3, 3, 3)), np.zeros((4, 4)), -np.eye(4), np.eye(3),
    np.full((4, 4), np.nan), np.eye(4) * 1e300, np.eye(4, dtype=complex), np.zeros((2, 2), "O"),
    np.array(["2020-01-01"], "datetime64[D]"), np.ma.masked_array([1.0], [True]),
]  # fmt: skip
"""values that nobody expects"""

# --- command lines

COMMANDS = 2 * [
    "marker aruco:4x4_50:7 --size 0.1 -o tag.ply --mixture fitted --quality marker.template=9",
    "marker qr:hello --json",
    "marker image:bits.png --mixture exact --native-2dgs -o tag.ply",
    "marker charuco:5x4:4x4_50 --json --max-splats 20000",
    "marker gridboard:2x3:4x4_50 -o board.ply",
    "marker aprilgrid:2x2:36h11 --size 0.4 --json",
    "marker svg-16:good.svg -o drawing.ply",
    "render scene.toml -o frames --outputs rgb,depth,label --device reference --quality fast,samples=2,order=pixel",
    "render none.ply -o a.png --device reference --json",
    "detect good.png --family 36h11 --scene scene.toml --json",
    "detect . --json",
    "source scene.toml --schedule group",
    "info good.ply --json",
    "devices --json",
] + [
    "check --device nowhere",
    "bench --scenes nothing --json out.json",
    "tradeoff --scenes nothing -o out",
    "tradeoff report nowhere -o out",
    "experiment nothing -o out",
    "experiment dataset --markers 9 -o out",
    "experiment merge nowhere -o out",
    "experiment report nowhere -o out",
    "demo --out /proc/nowhere",
    "warm nothing --device nowhere",
]
SLOW = ("check", "bench", "tradeoff", "experiment", "demo", "warm")
"""commands that would work for minutes, were their words good after all"""


def words(rng: Random, folder: Path) -> int:
    files.ground(folder)
    (folder / "scene.toml").write_text(files.scene_text(rng))
    given = rng.choice(COMMANDS).split()
    slow = given[0] in SLOW
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = rng.randrange(1, len(given) + 1)
        match rng.randrange(2 if slow else 6):
            case 0:
                given.insert(at, rng.choice(TEXTS))
            case 1:
                given.insert(
                    at, rng.choice(["--size", "--debugg", "--jsno", "-o", "--outputs", "--quality", "--seed"])
                )
            case 2:
                given[at - 1] = rng.choice(TEXTS)
            case 3:
                del given[at - 1]
            case 4:
                word = given[at - 1]
                cut = rng.randrange(len(word) + 1)
                given[at - 1] = word[:cut] + rng.choice(TEXTS)[:9] + word[cut + rng.randrange(2) :]
            case _:
                given[at - 1] = given[at - 1].replace("=", rng.choice("=,:")) + rng.choice(
                    ["", ",", "=", *NUMBERS]
                )
        given = given or [""]
    if slow:
        given.append("--debugg")
    with contextlib.chdir(folder):  # paths of the command line are relative to it
        return cli.main([word for word in given if word != "--debug"])


# --- Python


def calls(rng: Random, folder: Path) -> None:
    """A public function with one or two arguments that nobody expects, and what comes of it used."""
    files.ground(folder)
    from hostile_calls import CALLS

    name = rng.choice(sorted(CALLS))
    function, good, use = CALLS[name](folder)
    given = dict(good)
    for key in rng.sample(sorted(given), min(len(given), rng.choice([1, 1, 1, 2]))):
        given[key] = rng.choice(JUNK)
    try:
        made = function(**given)
        if use is not None:
            use(made)
    except fs.FidsplatError:
        raise
    except Exception as error:
        changed = ", ".join(
            f"{key}={_short(value)}" for key, value in given.items() if value is not good[key]
        )
        error.add_note(f"{name}({changed})")
        raise


def _short(value: Any) -> str:
    return repr(value)[:60] if not isinstance(value, np.ndarray) else f"array{value.shape} of {value.dtype}"


KINDS: dict[str, Callable[[Random, Path], int | None]] = {
    "words": words,
    "scenes": files.scenes,
    "splats": files.splats,
    "pictures": files.pictures,
    "drawings": files.drawings,
    "results": files.results,
    "calls": calls,
}
