"""Results of a trade-off on a device as a table, and the verdict on each setting."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fidsplat.capture.quality import PRESETS
from fidsplat.experiments.angles import largest, parse_tilts
from fidsplat.experiments.summary import Frame, Row, Summary, join, read_summary, records_of, summarise
from fidsplat.experiments.sweep import Record
from fidsplat.experiments.tradeoff.points import KNOBS, PRESETS_KNOB, Point, preset
from fidsplat.experiments.tradeoff.run import DECODE, LINEAR, NAME, POINT, TRUTH
from fidsplat.experiments.tradeoff.scenes import NAMES, is_marker, views_of
from fidsplat.experiments.tradeoff.session import DEFINITION
from fidsplat.util.errors import InputError

ABOUT = ("what", "scene", "knob", "value")
COLUMNS = (
    *ABOUT, "quality", "amount", "base_ms", "ratio", "ratio_low", "ratio_high", "maximum", "beyond",
    "rmse", "per_rectangle", "ideal_psnr", "corners_px", "read_to", "error",
)  # fmt: skip
TILT = 60
"""degrees: tilt of the marker images of a summary"""
TIME_CHANGES = 0.02
"""minimum relative difference of times, in addition to both quartiles"""
ERROR_CHANGES = 1.1
"""minimum factor between errors that differ"""
_NOTHING = "nothing"
"""text for the base"""
_TINY = 1e-6
"""errors below this are rounding"""
_VERDICTS = {
    (0, -1): "more accurate", (-1, -1): "more accurate", (1, -1): "slower, more accurate", (-1, 0): "faster",
    (-1, 1): "faster, less accurate", (0, 1): "dominated", (1, 1): "dominated", (1, 0): "slower",
    (0, 0): "no difference",
}  # fmt: skip


def rows_of(record: Record) -> Iterator[dict[str, Any]]:
    """Rows of a record; none for markers at tilts other than `TILT`."""
    key, found = record.key, record.result
    if key["what"] == POINT and is_marker(key["scene"]) and not key["scene"].endswith(f"@{TILT}"):
        return
    row: dict[str, Any] = {name: key.get(name) for name in ABOUT}
    row["amount"] = 0 if record.failed else 1 if key.get("quick") else 2
    if record.failed:
        row["error"] = found["error"]
    elif key["what"] == POINT:
        low, high = found["ratio_quartiles"]
        row |= {name: found.get(name) for name in COLUMNS if name in found}
        row |= {"ratio_low": low, "ratio_high": high, "beyond": found["maximum_sure"]}
        row["quality"] = quality_text(key["quality"])
        if "rectangles" in found:
            row["per_rectangle"] = found["splats"] / found["rectangles"]
    elif key["what"] == DECODE:
        row["read_to"] = largest(parse_tilts(key["tilts"]), found["read"])[1]
        row["amount"] = len(found["read"])
    elif key["what"] == LINEAR:
        row["maximum"] = found["maximum"]
    else:
        row |= {"value": ", ".join(str(key[name]) for name in DEFINITION), "maximum": found["maximum"]}
    yield row


def load(folders: Iterable[Path]) -> list[Device]:
    """The results in folders, raw or summarised, by device, processors first.

    Raises InputError when there are none, or a file holds something else.
    """
    folders = list(folders)
    found: dict[str, list[Summary]] = {}
    for folder in folders:
        by_device: dict[str, list[Record]] = {}
        for record in records_of(folder, NAME):
            if record.key.get("what") not in (POINT, DECODE, TRUTH, LINEAR):
                raise InputError(f"{folder} holds no results of fidsplat tradeoff; give folders that do")
            by_device.setdefault(record.run["device"], []).append(record)
        there = [summarise(records, rows_of, COLUMNS) for records in by_device.values()]
        there += [read_summary(file) for file in sorted(folder.glob("*.csv"))]
        if not there:
            raise InputError(f"no results in {folder}; run fidsplat tradeoff -o {folder}, or leave it out")
        for summary in there:
            found.setdefault(summary.runs[0]["device"], []).append(summary)
    devices = [Device(join(summaries, ABOUT)) for summaries in found.values()]
    devices = [device for device in devices if device.scenes]
    if not devices:
        raise InputError(
            f"no results in {', '.join(map(str, folders))}; run fidsplat tradeoff first, or give its folder"
        )
    return sorted(devices, key=lambda device: (device.kind != "cpu", device.name))


class Device:
    """The results of one device.

    A preset that has changed since is left out, but where its quality of today was measured by another name.
    """

    def __init__(self, summary: Summary) -> None:
        run, rows = summary.runs[0], summary.rows
        self.summary, self.name = summary, run["device"]
        self.title, self.kind = run.get("title", self.name), run.get("kind", "device")
        presets = rows["knob"] == PRESETS_KNOB
        stale = presets & (rows["quality"] != rows["value"].map(_today))
        points: Frame = rows[(rows["what"] == POINT) & rows["error"].isna() & ~stale]
        for name in rows.loc[presets, "value"].unique():
            same = points[points["quality"] == _today(name)].drop_duplicates("scene")
            named = same.assign(knob=PRESETS_KNOB, value=name)
            points = pd.concat([points, named]).drop_duplicates(["scene", "knob", "value"])
        names = pd.MultiIndex.from_frame(points[["scene", "knob", "value"]], names=[None] * 3)
        self.points = points.set_index(names)
        known = [view for name in NAMES for view in views_of(name)]
        self.own = [view for view in points["scene"].unique() if view not in known]
        """names of the user's views"""
        self.scenes = [view for view in (*self.own, *known) if (view, "base", "base") in self]

    def __contains__(self, point: tuple[str, str, str]) -> bool:
        return point in self.points.index

    def at(self, scene: str, knob: str, value: str) -> Row | None:
        """Row of a setting on a scene; None if it was not measured."""
        return self.points.loc[(scene, knob, value)] if (scene, knob, value) in self else None

    def of(self, scene: str) -> Frame:
        """Rows of a scene in the order of settings; `ms` is relative to the median of the base."""
        found: Frame = self.points[self.points["scene"] == scene]
        order = found["knob"].map(list(("base", *KNOBS)).index)
        found = found.iloc[order.argsort(kind="stable")]
        return found.assign(ms=self.base_ms(scene) * found["ratio"])

    def same_picture(self, scene: str) -> Frame:
        """Rows with the image definition of the base, whose errors are comparable."""
        found = self.of(scene)
        # gsplat's stop needs the order of centres, which without planes is the base's
        constants = found["quality"].str.replace("order=centre ", "")
        turned = found["quality"].where(found["knob"] == "order", constants).str.split(r"[ =]")
        return found[[not set(DEFINITION) & set(words) for words in turned]]

    def base_ms(self, scene: str) -> float:
        """Median time of the base in milliseconds."""
        return statistics.median(self.points.loc[self.points["scene"] == scene, "base_ms"])

    def noise(self, scene: str) -> float:
        """The share by which times differ for no reason: that of the base beside itself, and that between
        settings that were measured twice, under two names."""
        base = self.points.loc[(scene, "base", "base")]
        twice = self.of(scene).groupby("quality")["ratio"].agg(lambda ratios: ratios.max() / ratios.min() - 1)
        shares = [abs(base["ratio_low"] - 1), abs(base["ratio_high"] - 1), twice.max()]
        return max(TIME_CHANGES, *map(float, shares))

    def cost(self, point: Row) -> float:
        """A setting's time over the base's, for comparing settings with each other. A GPU's host delays both
        frames of a pair by as many milliseconds, so there their difference counts, over the base's median."""
        if self.kind != "gpu":
            return point["ratio"]
        return 1 + (point["ratio"] - 1) * point["base_ms"] / self.base_ms(point["scene"])

    def verdict(self, point: Row, other: Row) -> str:
        """Verdict on a setting relative to another with the same image definition."""
        signs = {_sign(point[name], other[name]) for name in ("maximum", "rmse")}
        if {-1, 1} <= signs:
            return "mixed"
        unit, least = other["ratio"], self.noise(point["scene"])
        time = 0
        if point["ratio"] / unit < 1 - least and point["ratio_high"] / unit < 1:
            time = -1
        elif point["ratio"] / unit > 1 + least and point["ratio_low"] / unit > 1:
            time = 1
        return _VERDICTS[time, next((sign for sign in signs if sign), 0)]

    def cheapest_within(self, scenes: Iterable[str], bound: float) -> list[Row]:
        """The setting, measured on all the scenes, whose error beyond certified flips is at most the bound on
        each and whose product of costs is least: what was measured of it, [] if there is none."""
        scenes = list(scenes)
        fit: Frame = pd.concat([self.same_picture(scene) for scene in scenes])
        best: tuple[float, list[Row]] = (math.inf, [])
        for _, found in fit.groupby(["knob", "value"], sort=False):
            worst = found["beyond"].fillna(found["maximum"]).max()
            there = [row for _, row in found.iterrows()]
            cost = math.prod(map(self.cost, there))
            if len(there) == len(scenes) and worst <= bound and cost < best[0]:
                best = cost, there
        return best[1]

    def read_to(self, marker: str, knob: str, value: str) -> float | None:
        """The largest tilt, degrees, up to which a marker is read at every tilt of the scan; None if it was
        not scanned or is not read frontally."""
        rows, wanted = self.summary.rows, (DECODE, marker, knob, value)
        same = [rows[column] == one for column, one in zip(ABOUT, wanted, strict=True)]
        found = rows.loc[np.logical_and.reduce(same), "read_to"].dropna()
        return None if found.empty else float(found.iloc[0])


def front(points: Frame) -> Frame:
    """Pareto front of time and error, sorted by time."""
    ranked = points.sort_values(["ratio", "maximum"])
    best = ranked["maximum"].cummin().shift(fill_value=math.inf)
    return ranked[ranked["maximum"] < best]


def _sign(error: float, other: float) -> int:
    error, other = max(error, _TINY), max(other, _TINY)
    return int(error > other * ERROR_CHANGES) - int(error * ERROR_CHANGES < other)


def quality_text(changes: dict[str, Any]) -> str:
    """Differences of a quality from the base, e.g. "alpha_cutoff=1e-05 marker.template=9"."""
    words = []
    for name, value in sorted(changes.items()):
        if isinstance(value, dict):
            words += [f"{name}.{word}" for word in quality_text(value).split()]
        else:
            words.append(f"{name}={value:.6g}" if isinstance(value, float) else f"{name}={value}")
    return " ".join(words) or _NOTHING


def _today(name: str) -> str | None:
    """Differences of a preset from the base; None if the preset no longer exists."""
    return quality_text(Point(PRESETS_KNOB, name, preset(name)).key()["quality"]) if name in PRESETS else None
