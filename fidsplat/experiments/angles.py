"""Table 3 of the paper: largest tilts at which markers are found and read, and missed tilts below them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor, Future

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.methods import IDEAL, MarkerRenderer
from fidsplat.experiments.setup import CATEGORIES, PROTOCOLS
from fidsplat.images.files import to_uint8
from fidsplat.markers import marker
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.vision.readers import Attempt, Target, attempt, readers

NAME = "angles"
FULL_TILTS = "0:89.8:0.2"
QUICK_TILTS = "0:60:20,64:88:2"


def parse_tilts(text: str) -> list[float]:
    """Ascending degrees for "first:last:step[,first:last:step...]". Raises InputError for another format."""
    tilts: set[float] = set()
    for span in text.split(","):
        try:
            first, last, step = (float(number) for number in span.split(":"))
            if not (0 <= first <= last < 90 and 0.01 <= step <= 90):
                raise ValueError
        except ValueError:
            raise InputError(
                "tilts must be first:last:step in degrees with 0 <= first <= last < 90, joined by commas, "
                f"e.g. {FULL_TILTS}, got {text!r}"
            ) from None
        count = math.floor((last - first) / step + 1e-6) + 1
        tilts |= {round(first + i * step, 6) for i in range(count)}
    return sorted(tilts)


def measure_angles(point: dict, markers: MarkerRenderer, seed: int, pool: Executor, workers: int) -> dict:
    """Read a marker at every tilt with every detector.

    Returns two strings of 0 and 1 per detector, with one digit per tilt: whether the code was `found` (the
    detected outline overlaps half of the code), and `read` correctly.
    """
    category, protocol = CATEGORIES[point["category"]], PROTOCOLS[point["protocol"]]
    spec = category.spec(point["index"], seed)
    printed = marker(spec)
    module = protocol.module(printed.grid.shape[0])
    render = markers.prepare(point["method"], f"{category.name}-{point['index']}", spec, module)
    names = readers(category.kind)
    outline = printed.corners / printed.module * module
    in_pool = point["method"] == IDEAL  # threads cannot share a renderer

    def detect(image: np.ndarray, camera: Camera) -> list[Attempt]:
        corners = camera.project(outline)
        target = Target(category.kind, printed.family or "", printed.id, printed.payload, corners)
        grey = to_uint8(image)
        return [attempt(name, grey, target) for name in names]

    def submitted(tilt: float) -> Future[list[Attempt]]:
        camera = protocol.camera(tilt)
        if in_pool:
            return pool.submit(lambda: detect(render(camera), camera))
        return pool.submit(detect, render(camera), camera)

    attempts = interrupts.ordered_results(map(submitted, parse_tilts(point["tilts"])), 2 * workers)
    return {
        "spec": spec if category.kind == "apriltag" else printed.family,
        "readers": {
            name: {
                key: "".join("01"[getattr(at_tilt, key)] for at_tilt in by_tilt) for key in ("found", "read")
            }
            for name, by_tilt in zip(names, zip(*attempts, strict=True), strict=True)
        },
    }


def largest(tilts: Sequence[float], hits: str) -> tuple[float | None, float | None]:
    """Largest tilt with a hit, and largest tilt below the first miss; None if there is none."""
    last, first_miss = hits.rfind("1"), len(hits) - len(hits.lstrip("1"))
    return tilts[last] if last >= 0 else None, tilts[first_miss - 1] if first_miss else None
