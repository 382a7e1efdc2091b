"""How the time of a frame grows: with the splats, the pixels, and the splats that lie over one another."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.base import Rates
from fidsplat.cameras import Camera
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.experiments.bench.measure import SceneRun
from fidsplat.experiments.bench.overdraw import overdraw
from fidsplat.random_clouds import random_cloud, standard_camera
from fidsplat.splats import SplatCloud
from fidsplat.timing import take_turns

MILLION = 1_000_000


@dataclass(frozen=True)
class Point:
    """One scene of a series."""

    series: str
    x: float
    """what the series is over: splats, pixels, or the factor on the splats' size"""
    count: int
    median_scale: float
    """metres"""
    width: int
    height: int

    def make(self) -> tuple[SplatCloud, Camera]:
        """The random scene, as those of random_clouds.py."""
        return random_cloud(self.count, self.median_scale), standard_camera(self.width, self.height)


def points() -> dict[str, list[Point]]:
    """Every series, each from little to much.

    splats: 10^4 to 2 x 10^7 in 1080p, smaller as they get more, so that they cover the same area in all.
    pixels: 0.25 to 8 million of the million splats of r1m_1080p. overdraw: 300,000 splats in 1080p, from half
    to eight times the size of those of r1m_1080p.
    """
    counts = [10_000, 30_000, 100_000, 300_000, MILLION, 3 * MILLION, 10 * MILLION, 20 * MILLION]
    over_splats = [Point("splats", n, n, 0.012 * math.sqrt(MILLION / n), 1920, 1080) for n in counts]
    over_pixels = []
    for pixels in (0.25, 0.5, 1, 2, 4, 8):
        height = round(math.sqrt(pixels * MILLION * 9 / 16) / 9) * 9
        width = height * 16 // 9
        over_pixels.append(Point("pixels", width * height, MILLION, 0.012, width, height))
    over_size = [
        Point("overdraw", factor, 300_000, 0.012 * factor, 1920, 1080) for factor in (0.5, 1, 2, 4, 8)
    ]
    return {"splats": over_splats, "pixels": over_pixels, "overdraw": over_size}


def measure(point: Point, device: str, rates: Rates | None, repeats: int) -> dict:
    """The record of a point: as in `fidsplat bench --json`, with its series and x; for the series `overdraw`
    also `layers_per_pixel`, the fragments that lie over a pixel whether or not it lets light through to them.

    A device that cannot draw it says so in `error`.
    """
    cloud, camera = point.make()
    run = SceneRun(f"{point.series} {point.x:g}", device, rates, cloud, camera)
    del cloud
    take_turns([run.result.timer], repeats)
    record = run.result.as_dict() | {"series": point.series, "x": point.x}
    if point.series == "overdraw" and "fragments" in record:
        layers = overdraw(run.renderer, run.resident, camera, TIMED.with_(transmittance_stop=0.0))
        record["layers_per_pixel"] = float(layers.mean(dtype=np.float64))
    return record


def abscissa(record: dict) -> float:
    """What a record is plotted over: x, but in the series `overdraw` the layers per pixel."""
    return record.get("layers_per_pixel", record["x"])


def exponent(x: Sequence[float], y: Sequence[float]) -> float | None:
    """p of the least-squares fit y = c x^p through the upper half of the points, where what is fixed no
    longer counts (all of them if there are at most three); None for fewer than two."""
    pairs = [(a, b) for a, b in zip(x, y, strict=True) if a > 0 and b > 0]
    upper = pairs[len(pairs) // 2 :] if len(pairs) > 3 else pairs
    if len(upper) < 2:
        return None
    logs = np.log(np.array(upper, dtype=np.float64))
    return float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])


def exponents(records: Sequence[dict]) -> Iterator[tuple[str, str, dict[str, float | None]]]:
    """For each device and series: the exponents of `frame` and of each stage, from the fastest of the
    repeats, which other work on the machine disturbs least."""
    drawn = [record for record in records if not record.get("error") and "frame_ms" in record]
    for title, series in dict.fromkeys((record["title"], record["series"]) for record in drawn):
        chosen = [record for record in drawn if (record["title"], record["series"]) == (title, series)]
        chosen.sort(key=abscissa)
        over = [abscissa(record) for record in chosen]
        found = {"frame": exponent(over, [record["fastest_ms"] for record in chosen])}
        for stage in chosen[0]["fastest_stages_ms"]:
            times = [record["fastest_stages_ms"].get(stage, 0.0) for record in chosen]
            found[stage] = exponent(over, times)
        yield title, series, found
