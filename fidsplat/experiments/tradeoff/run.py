"""Runs the sweep: the parts that there are, most telling first, and one after the other to a file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fidsplat.accuracy import TRUTH_CUTOFF
from fidsplat.errors import FidsplatError
from fidsplat.experiments.records import Records
from fidsplat.experiments.tradeoff import decoding, points, scenes
from fidsplat.experiments.tradeoff.judging import check_truth, judge_picture
from fidsplat.experiments.tradeoff.points import ALONE, BASE, MARKER_KNOB, PRESETS_KNOB
from fidsplat.experiments.tradeoff.table import DEFINITION, Table
from fidsplat.experiments.tradeoff.timing import FULL, QUICK, time_point
from fidsplat.files import writable_folder
from fidsplat.provenance import run_facts
from fidsplat.render import Renderer
from fidsplat.vision.metrics import metric_versions
from fidsplat.vision.readers import reader_versions

NAME = "tradeoff"
FILE = f"{NAME}.jsonl"
POINT, DECODE, TRUTH = "point", "decode", "truth"
IDEAL = "ideal"
_EARLY = ("base", PRESETS_KNOB, ALONE, "alpha_cutoff", "transmittance_stop", MARKER_KNOB)
_BATCH = 16
"""parts at most whose pictures wait to be looked at"""


@dataclass(frozen=True)
class Settings:
    """What a run is to measure."""

    out: Path
    device: str
    scenes: tuple[str, ...] = ()
    knobs: tuple[str, ...] = ()
    quick: bool = False
    anew: bool = False
    workers: int = min(_BATCH, os.cpu_count() or 1)
    """threads that look at pictures, while nothing is timed"""


@dataclass(frozen=True, eq=False)
class Plan:
    """A run that is ready to go."""

    records: Records
    work: list[dict]
    table: Table
    pool: ThreadPoolExecutor
    settings: Settings

    @property
    def left(self) -> int:
        """Parts that are still to be measured."""
        return self.records.missing(self.work)

    def run(self) -> Iterator[dict]:
        """Measure what is missing; yields each line when it is in the file.

        A few parts are drawn and timed, then their pictures are looked at in several threads, so that neither
        disturbs the other.
        """
        left, size = self.records.left(self.work), self.settings.workers
        for first in range(0, len(left), size):
            batch = left[first : first + size]
            looks = [self.begin(part) for part in batch]
            for part, result in zip(batch, self.pool.map(lambda look: look(), looks), strict=True):
                yield self.records.append(part, _rounded(result))

    def begin(self, part: dict) -> Callable[[], dict]:
        """Do the device's share of a part; what is returned does the host's. What a device refuses to draw
        is a result with `error`."""
        try:
            return _begin(self.table, part, self.settings.quick)
        except FidsplatError as error:
            message = str(error)
            return lambda: {"error": message}


@contextmanager
def planned(settings: Settings) -> Iterator[Plan]:
    """A run with all that it needs.

    Raises InputError for settings that cannot be used, DeviceError when the device cannot be opened.
    """
    work = all_parts(settings.scenes, settings.knobs, settings.quick)
    writable_folder(settings.out)
    renderer = Renderer(settings.device)
    info = renderer.device
    versions = reader_versions() | metric_versions() | {"pyopencl": version("pyopencl")}
    facts = run_facts(f"{info.title}, {info.version}", scenes.SEED, versions)
    facts |= {"kind": info.kind, "title": info.title}
    records = Records(settings.out / FILE, facts, settings.anew)
    # a device that failed may be there again: what has an error is not done
    records.done = {key: line for key, line in records.done.items() if "error" not in line["result"]}
    pool = ThreadPoolExecutor(settings.workers)
    try:
        yield Plan(records, work, Table(renderer), pool, settings)
    finally:
        # an interrupt must not wait for pictures that nobody will look at
        pool.shutdown(cancel_futures=True)


def all_parts(names: tuple[str, ...], knobs: tuple[str, ...], quick: bool) -> list[dict]:
    """The parts of a run, as keys of results.

    Raises:
        InputError: an unknown scene or knob.
    """
    chosen, turned = scenes.scene_names(names, quick), points.knob_names(knobs)
    found: list[tuple[int, dict]] = []
    for name in chosen:
        marked = scenes.is_marker(name)
        every = name not in scenes.FEW_KNOBS and not (marked and quick)
        for view in scenes.views_of(name):
            defined: set[tuple] = set()
            for point in points.points(turned, marked, quick, every):
                if name == "r1m_1080p" and point.quality.samples > 2:
                    continue  # 18 million samples: minutes on a CPU for what the smaller scene shows too
                tier = 0 if point.knob in _EARLY else 2
                found.append((tier, {"what": POINT, "scene": view, **point.key(), "quick": quick}))
                rule = point.quality.coplanar if marked else BASE.coplanar  # only markers have planes
                definition = (point.quality.lowpass, point.quality.samples, rule)
                if point.knob != MARKER_KNOB and definition not in defined:
                    defined.add(definition)
                    found.append((tier + 1, _truth_part(view, definition)))
        if marked:
            tilts = decoding.QUICK_TILTS if quick else decoding.FULL_TILTS
            ideal = {"knob": IDEAL, "value": IDEAL, "quality": None}
            keys = [ideal, *(point.key() for point in points.decode_points(turned, quick))]
            found += [(1, {"what": DECODE, "scene": name, **key, "tilts": tilts}) for key in keys]
    return [part for _, part in sorted(found, key=lambda pair: pair[0])]


def _truth_part(view: str, definition: tuple) -> dict:
    return {"what": TRUTH, "scene": view, **dict(zip(DEFINITION, definition, strict=True))}


def _rounded(value: Any) -> Any:
    """Numbers to six digits: no measurement has more, and lines stay short."""
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _begin(table: Table, part: dict, quick: bool) -> Callable[[], dict]:
    view = part["scene"]
    if part["what"] == DECODE:
        quality = None if part["quality"] is None else points.quality_of(part["quality"])
        return decoding.scan(table, view, quality, part["tilts"])
    if part["what"] == TRUTH:
        asked = BASE.with_(**{name: part[name] for name in DEFINITION})
        full, truth = table.full(view, asked), table.truth(view, asked)
        scene = table.scene(view, asked.marker).scene
        facts = {"blend_precision": full.blend_precision, "alpha_cutoff": TRUTH_CUTOFF}
        return lambda: facts | check_truth(truth, scene, full)
    quality = points.quality_of(part["quality"])
    frame, times = time_point(table, view, quality, QUICK if quick else FULL)
    picture, truth = frame["rgb"], table.truth(view, quality)
    scene = table.scene(view, quality.marker).scene
    return lambda: times | judge_picture(picture, truth, scene, quality)
