"""Command `fidsplat info`: describe a splat file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from fidsplat.commands.options import Json
from fidsplat.commands.output import delayed_progress, report
from fidsplat.util.markup import point


@dataclass
class Info:
    """Describe a splat file: number, kind and bounds of its splats.

    Bounds enclose all splats, and the middle 99 % of their centres along each axis, since captures have
    outliers. The up axis is a guess from level surfaces, or from a side that is by far the longest. The
    command suggests size and pose of a first marker that faces the camera of `fidsplat render FILE.ply`.

    Examples:
      fidsplat info scene.ply
      fidsplat info scene.ply --json
    """

    file: tyro.conf.Positional[str]
    """FILE: PLY, .splat, SPZ, glTF or USD file, or a store"""
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.commands.store import report_store
        from fidsplat.formats.files import stored_bytes
        from fidsplat.splats.statistics import describe
        from fidsplat.store.layout import SUFFIX

        if Path(self.file).suffix.lower() == SUFFIX:
            return report_store(self.file, self.json)
        with delayed_progress() as progress:
            cloud = fs.load_splats(self.file, progress)
        facts = {"file": self.file, "bytes": stored_bytes(self.file), **describe(cloud)}
        return report(self.json, facts, table=(self.file, ("", ""), _rows(facts)))


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    from fidsplat.splats.statistics import PERCENTILES

    rows = [
        ("splats", f"{facts['splats']:,} ({facts['kind']}), SH degree {facts['sh_degree']}"),
        ("file", f"{facts['bytes'] / 2**20:.1f} MiB"),
    ]
    rows += [("left out", f"{count:,}: {why}") for why, count in facts["left_out"].items()]
    if not facts["splats"]:
        return rows

    scales, opacities = (" / ".join(f"{v:.3g}" for v in facts[key]) for key in ("scales", "opacities"))
    percents = " / ".join(map(str, PERCENTILES))
    low, high = facts["middle_bounds"]
    place = f"position = {point(facts['marker_position'])}, quaternion = {point(facts['marker_quaternion'])}"
    place += ": a tenth of the scene, in front of its middle"
    return [
        *rows,
        ("bounds", " to ".join(map(point, facts["bounds"])) + " m"),
        ("middle 99 %", f"{point(low)} to {point(high)} m"),
        ("up", f"{facts['up']}? ({facts['up_because']}), {facts['height']:.3g} m high"),
        ("longer scale", f"{scales} m at {percents} %; {facts['aspect']:.2g} times the shorter (median)"),
        ("opacity", f"{opacities} at {percents} %"),
        ("a first marker", f"size = {facts['marker_size']:g}, {place}"),
    ]
