"""Table 3: the largest tilts at which markers are found and read.

Every detector reads the image of every tilt, so that gaps are found.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from fidsplat.experiments.methods import IDEAL, Painter, plain_marker
from fidsplat.experiments.setup import CATEGORIES, PROTOCOLS, Category
from fidsplat.images.files import to_uint8
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.vision.readers import Target, attempt, readers

NAME = "angles"
FULL_TILTS = "0:89.8:0.2"
QUICK_TILTS = "0:60:20,64:88:2"


def parse_tilts(text: str) -> list[float]:
    """Degrees of "first:last:step[,first:last:step...]", rising. Raises InputError for anything else."""
    found: set[float] = set()
    for span in text.split(","):
        try:
            first, last, step = (float(number) for number in span.split(":"))
            if not (0 <= first <= last < 90 and 0.01 <= step <= 90):
                raise ValueError
        except ValueError:
            raise InputError(
                f"tilts are {text!r}; write first:last:step in degrees, 0 <= first <= last < 90, "
                f"joined by commas, e.g. {FULL_TILTS}"
            ) from None
        count = math.floor((last - first) / step + 1e-6) + 1
        found |= {round(first + i * step, 6) for i in range(count)}
    return sorted(found)


def angles_points(
    categories: Iterable[Category],
    protocols: Iterable[str],
    methods: Iterable[str],
    tilts: str = FULL_TILTS,
    markers: int = 5,
) -> list[dict]:
    """Points of the experiment: scans by marker, method and protocol."""
    parse_tilts(tilts)
    return [
        {"protocol": p, "category": c.name, "index": i, "method": m, "tilts": tilts}
        for p in protocols
        for c in categories
        for i in range(markers)
        for m in methods
    ]


def measure_angles(point: dict, painter: Painter, seed: int, pool: ThreadPoolExecutor, workers: int) -> dict:
    """Scan one marker.

    Returns two strings of 0 and 1 per detector, one digit per tilt: whether the code was `found` (its outline
    overlaps the code by half), and `read` exactly.
    """
    category, protocol = CATEGORIES[point["category"]], PROTOCOLS[point["protocol"]]
    spec = category.spec(point["index"], seed)
    made = plain_marker(spec)
    module = protocol.module(made.grid.shape[0])
    draw = painter.open(point["method"], f"{category.name}-{point['index']}", spec, module)
    names = readers(category.kind)
    outline = made.corners / made.module * module
    in_pool = point["method"] == IDEAL  # a renderer is not shared by threads

    def look(picture: np.ndarray, tilt: float) -> list[tuple[bool, bool]]:
        target = Target(
            category.kind, made.family or "", made.id, made.payload, protocol.camera(tilt).project(outline)
        )
        grey = to_uint8(picture)
        tries = [attempt(name, grey, target) for name in names]
        return [(one.found, one.read) for one in tries]

    waiting: deque[Future] = deque()
    seen: list[list[tuple[bool, bool]]] = []
    for tilt in parse_tilts(point["tilts"]):
        camera = protocol.camera(tilt)
        if in_pool:
            waiting.append(pool.submit(lambda c, t: look(draw(c), t), camera, tilt))
        else:
            waiting.append(pool.submit(look, draw(camera), tilt))
        while len(waiting) > 2 * workers:  # bounds memory
            seen.append(interrupts.result_of(waiting.popleft()))
    seen += [interrupts.result_of(future) for future in waiting]
    return {
        "spec": spec if category.kind == "apriltag" else made.family,
        "readers": {
            name: {
                key: "".join("01"[tries[i][which]] for tries in seen)
                for which, key in enumerate(("found", "read"))
            }
            for i, name in enumerate(names)
        },
    }


def largest(tilts: Sequence[float], hits: str) -> tuple[float | None, float | None]:
    """Largest tilt of all hits, and largest tilt without a miss up to it; None if there is none."""
    good = [tilt for tilt, hit in zip(tilts, hits, strict=True) if hit == "1"]
    unbroken = len(hits) - len(hits.lstrip("1"))
    return (good[-1] if good else None), (tilts[unbroken - 1] if unbroken else None)
