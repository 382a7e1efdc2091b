"""Results of one device, by what they are of."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fidsplat.errors import InputError
from fidsplat.experiments.angles import largest, parse_tilts
from fidsplat.experiments.records import key_of, read_lines
from fidsplat.experiments.tradeoff.points import ALONE, KNOBS, MARKER_KNOB, PRESETS_KNOB, TOGETHER, Point
from fidsplat.experiments.tradeoff.run import DECODE, IDEAL, POINT, TRUTH
from fidsplat.experiments.tradeoff.scenes import NAMES, is_marker, views_of
from fidsplat.experiments.tradeoff.table import DEFINITION
from fidsplat.quality import PRESETS


@dataclass(frozen=True)
class Measured:
    """One setting on one scene."""

    scene: str
    knob: str
    value: str
    quality: dict
    """what it changes in the base"""
    result: dict

    @property
    def words(self) -> str:
        """The setting in words."""
        if self.knob == ALONE:
            return self.value if self.value == "exact" else f"exact but for {self.value}"
        if self.knob in ("base", PRESETS_KNOB, TOGETHER, MARKER_KNOB):
            return self.value
        return f"{self.knob} {self.value}"

    @property
    def ratio(self) -> float:
        """Its time over the base's."""
        return self.result["ratio"]

    @property
    def maximum(self) -> float:
        """Largest error."""
        return self.result["maximum"]

    @property
    def sure(self) -> float:
        """Largest error beyond certificates where they are known, else the largest."""
        sure = self.result["maximum_sure"]
        return self.maximum if sure is None else sure

    @property
    def same_picture(self) -> bool:
        """Whether its definition is the base's, so that errors may be compared."""
        # without coplanar splats their rule defines nothing
        knobs = (knob for knob in DEFINITION if knob != "coplanar" or is_marker(self.scene))
        return not any(knob in self.quality for knob in knobs)


class Results:
    """Lines of one device.

    Args:
        device: its title and driver; `title` is without the driver.
        lines: of `tradeoff.jsonl`, one for each part. A preset that has changed since is left out, but where
            its setting of today was measured under another name.
    """

    def __init__(self, device: str, lines: Sequence[dict]) -> None:
        self.device, self.lines = device, lines
        self.title = lines[0]["run"].get("title", device)
        self.kind = lines[0]["run"].get("kind", "")
        self.points: dict[tuple[str, str, str], Measured] = {}
        self.refused: dict[str, str] = {}
        self.truths: list[dict] = []
        self._scans: dict[tuple[str, str, str], dict] = {}
        presets: dict[str, None] = {}
        for line in lines:
            key, result = line["key"], line["result"]
            if "error" in result:
                self.refused.setdefault(f"{key.get('knob', 'truth')} {key.get('value', '')}", result["error"])
            elif key["what"] == POINT:
                point = Measured(key["scene"], key["knob"], key["value"], key["quality"], result)
                if point.knob == PRESETS_KNOB:
                    presets[point.value] = None
                    if point.quality != _today(point.value):
                        continue  # the preset has changed since
                known = self.points.get((point.scene, point.knob, point.value))
                # of a quick run and a full one the full one counts
                if known is None or known.result["repeats"] < result["repeats"]:
                    self.points[point.scene, point.knob, point.value] = point
            elif key["what"] == DECODE:
                where = (key["scene"], key["knob"], key["value"])
                if where not in self._scans or len(self._scans[where]["result"]["read"]) < len(
                    result["read"]
                ):
                    self._scans[where] = line
            elif key["what"] == TRUTH:
                self.truths.append(line)
        self._name_presets(presets)

    def _name_presets(self, names: Iterable[str]) -> None:
        """Give the names of presets to points that have their settings under another name."""
        for name in names:
            for point in list(self.points.values()):
                if point.quality == _today(name):
                    named = replace(point, knob=PRESETS_KNOB, value=name)
                    self.points.setdefault((point.scene, PRESETS_KNOB, name), named)

    @property
    def scenes(self) -> list[str]:
        """Pictures that have a base, in their order."""
        there = {scene for scene, knob, _ in self.points if knob == "base"}
        return [view for name in NAMES for view in views_of(name) if view in there]

    def of(self, scene: str) -> list[Measured]:
        """What was measured on a scene: base, presets, knobs in their order."""
        order = ("base", *KNOBS)
        found = [point for point in self.points.values() if point.scene == scene]
        return sorted(found, key=lambda point: order.index(point.knob))

    def at(self, scene: str, knob: str, value: str) -> Measured | None:
        """One setting on a scene."""
        return self.points.get((scene, knob, value))

    def base(self, scene: str) -> Measured:
        """The base on a scene of `scenes`."""
        return self.points[scene, "base", "base"]

    def base_ms(self, scene: str) -> float:
        """Milliseconds of the base: the median over all settings that it was drawn beside."""
        return statistics.median(point.result["base_ms"] for point in self.of(scene))

    def base_range(self, scene: str) -> tuple[float, float]:
        """`base_ms` of the setting beside which the base was the fastest, and the slowest."""
        times = [point.result["base_ms"] for point in self.of(scene)]
        return min(times), max(times)

    def cost(self, point: Measured) -> float:
        """Its time over the base's, for comparing settings with each other. A GPU's host delays both frames
        of a pair by as many milliseconds, so there their difference counts, over the base's median."""
        if self.kind != "gpu":
            return point.ratio
        return 1 + (point.ratio - 1) * point.result["base_ms"] / self.base_ms(point.scene)

    def angle(self, marker: str, knob: str, value: str) -> float | None:
        """The largest tilt up to which every tilt of the scan is read, degrees; None if it was not scanned
        or is not read frontally."""
        line = self._scans.get((marker, knob, value))
        return None if line is None else largest(parse_tilts(line["key"]["tilts"]), line["result"]["read"])[1]

    def ceiling(self, marker: str) -> float | None:
        """`angle` of the ideal texture."""
        return self.angle(marker, IDEAL, IDEAL)

    def settings(self) -> list[tuple[str, str]]:
        """Every (knob, value) that was measured anywhere, in order."""
        order = ("base", *KNOBS)
        found = dict.fromkeys((point.knob, point.value) for point in self.points.values())
        return sorted(found, key=lambda pair: order.index(pair[0]))


def _today(name: str) -> dict | None:
    """What a preset changes in the base; None where there is none of that name any more."""
    return Point(PRESETS_KNOB, name, PRESETS[name]).key()["quality"] if name in PRESETS else None


def load(folders: Iterable[Path]) -> list[Results]:
    """The results in folders (every *.jsonl in them), by device, processors first.

    Raises:
        InputError: there are none, or a file holds something else.
    """
    folders = list(folders)
    by_device: dict[str, dict[str, dict]] = {}
    for folder in folders:
        files = sorted(folder.glob("*.jsonl"))
        if not files:
            raise InputError(f"no results in {folder}; run fidsplat tradeoff -o {folder}, or leave it out")
        for file in files:
            for line in read_lines(file):
                try:
                    device, known = line["run"]["device"], line["key"]["what"] in (POINT, DECODE, TRUTH)
                except (KeyError, TypeError):
                    known = False
                if not known:
                    raise InputError(f"{file} holds no results of fidsplat tradeoff; give folders that do")
                lines, key = by_device.setdefault(device, {}), key_of(line)
                if key not in lines or "error" in lines[key]["result"]:
                    lines[key] = line
    found = [Results(device, list(lines.values())) for device, lines in by_device.items()]
    found = [results for results in found if results.scenes]
    if not found:
        names = ", ".join(map(str, folders))
        raise InputError(f"no results in {names}; run fidsplat tradeoff first, or give its folder")
    return sorted(found, key=lambda results: (results.kind != "cpu", results.device))
