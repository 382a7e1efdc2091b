"""Results of `fidsplat tradeoff` as a table for each device."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from fidsplat.capture.quality import PRESETS
from fidsplat.experiments.summary import Row, Summary, Table, join, read_summary, summarise
from fidsplat.experiments.sweep import Record, folder_records
from fidsplat.experiments.tradeoff.points import PRESET, SETTINGS, Point, preset
from fidsplat.experiments.tradeoff.run import NAME
from fidsplat.experiments.tradeoff.scenes import NAMES, is_marker, views_of
from fidsplat.experiments.tradeoff.session import DEFINITION
from fidsplat.util.errors import InputError

KEYS = ("scene", "setting", "value")
COLUMNS = (
    *KEYS, "quality", "amount", "base_ms", "ratio", "ratio_low", "ratio_high", "maximum", "beyond",
    "rmse", "per_rectangle", "ideal_psnr", "corners_px", "error",
)  # fmt: skip
TILT = 60
"""tilt in degrees of the markers in a summary"""


def rows_of(record: Record) -> Iterator[dict[str, Any]]:
    """Rows of a record; none for markers at tilts other than `TILT`."""
    key, result = record.key, record.result
    if is_marker(key["scene"]) and not key["scene"].endswith(f"@{TILT}"):
        return
    row: dict[str, Any] = {name: key.get(name) for name in KEYS}
    row["amount"] = 0 if record.failed else 1 if key.get("quick") else 2
    if record.failed:
        row["error"] = result["error"]
    else:
        low, high = result["ratio_quartiles"]
        row |= {name: result[name] for name in COLUMNS if name in result}
        row |= {"ratio_low": low, "ratio_high": high, "beyond": result["maximum_sure"]}
        row["quality"] = quality_text(key["quality"])
        if "rectangles" in result:
            row["per_rectangle"] = result["splats"] / result["rectangles"]
    yield row


def load(folders: Iterable[Path]) -> list[DeviceResults]:
    """Read raw or summarised results from folders: one item per device, starting with CPUs.

    Raises:
        InputError: a folder has no results, or results of another command.
    """
    folders = list(folders)
    by_device: dict[str, list[Summary]] = {}
    for folder in folders:
        records: dict[str, list[Record]] = {}
        for record in folder_records(folder, NAME):
            if "setting" not in record.key:
                raise InputError(
                    f"results in {folder} must be of fidsplat tradeoff, got those of another command or an "
                    "earlier version; give another folder"
                )
            records.setdefault(record.run["device"], []).append(record)
        summaries = [summarise(device_records, rows_of, COLUMNS) for device_records in records.values()]
        summaries += [read_summary(file) for file in sorted(folder.glob("*.csv"))]
        if not summaries:
            raise InputError(f"results must be in {folder}, got none; run fidsplat tradeoff -o {folder}")
        for summary in summaries:
            by_device.setdefault(summary.runs[0]["device"], []).append(summary)
    devices = [DeviceResults(join(summaries, KEYS)) for summaries in by_device.values()]
    devices = [device for device in devices if device.scenes]
    if not devices:
        raise InputError(
            f"results must be in {', '.join(map(str, folders))}, got none; run fidsplat tradeoff first"
        )
    return sorted(devices, key=lambda device: (device.kind != "cpu", device.name))


class DeviceResults:
    """Results of a device, without presets that were changed after their measurement."""

    def __init__(self, summary: Summary) -> None:
        run, rows = summary.runs[0], summary.rows
        self.summary, self.name = summary, run["device"]
        self.title, self.kind = run.get("title", self.name), run.get("kind", "device")
        stale = (rows["setting"] == PRESET) & (rows["quality"] != rows["value"].map(_current_quality))
        points: Table = rows[rows["error"].isna() & ~stale]
        names = pd.MultiIndex.from_frame(points[["scene", "setting", "value"]], names=[None] * 3)
        self.points = points.set_index(names)
        known = [view for name in NAMES for view in views_of(name)]
        self.own = [view for view in points["scene"].unique() if view not in known]
        """names of the user's views"""
        self.scenes = [view for view in (*self.own, *known) if (view, "base", "base") in self.points.index]

    def at(self, scene: str, setting: str, value: str) -> Row | None:
        """Row of a setting on a scene; None if it was not measured."""
        key = (scene, setting, value)
        return self.points.loc[key] if key in self.points.index else None

    def of(self, scene: str) -> Table:
        """Measured rows of a scene, in the order of `SETTINGS`.

        `ms` is the ratio of the time to the base's, times the median time of the base.
        """
        rows: Table = self.points[self.points["scene"] == scene]
        order = rows["setting"].map(list(("base", *SETTINGS)).index)
        rows = rows.iloc[order.argsort(kind="stable")]
        return rows.assign(ms=self.base_ms(scene) * rows["ratio"])

    def same_definition(self, scene: str) -> Table:
        """Rows with the low-pass, samples and order of the base setting, whose errors are comparable."""
        rows = self.of(scene)
        # gsplat's stop requires order=centre, which renders as the base's order without coplanar groups
        constants = rows["quality"].str.replace("order=centre ", "")
        changed = rows["quality"].where(rows["setting"] == "order", constants).str.split(r"[ =]")
        return rows[[not set(DEFINITION) & set(words) for words in changed]]

    def base_ms(self, scene: str) -> float:
        """Median time of the base in milliseconds."""
        return statistics.median(self.points.loc[self.points["scene"] == scene, "base_ms"])


def quality_text(changes: dict[str, Any]) -> str:
    """Differences of a quality from the base as text, e.g. "alpha_cutoff=1e-05 marker.template=9"."""
    words = []
    for name, value in sorted(changes.items()):
        if isinstance(value, dict):
            words += [f"{name}.{word}" for word in quality_text(value).split()]
        else:
            words.append(f"{name}={value:.6g}" if isinstance(value, float) else f"{name}={value}")
    return " ".join(words) or "nothing"


def _current_quality(name: str) -> str | None:
    """Differences of a preset from the base; None if the preset no longer exists."""
    return quality_text(Point(PRESET, name, preset(name)).key()["quality"]) if name in PRESETS else None
