"""`fidsplat info`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from fidsplat.commands.output import Json, console, late_progress, option, print_json, print_table

if TYPE_CHECKING:
    from fidsplat.splats import SplatCloud

SHARES = (1, 50, 99)
"""percent"""

FLAT = 0.94
"""Cosine of 20 degrees: a splat is level when its normal is nearer than this to the axis."""


@dataclass
class Info:
    """Say what a splat file holds, where, and how large it is.

    Bounds are of all splats, and of the middle 99 % of their centres along each axis: captures have strays
    far away. Which way is up is a guess: along the axis to which most of the area is level, away from where
    that area lies. From these comes a place and a size for a first marker.

    Examples:
      fidsplat info scene.ply
      fidsplat info scene.ply --json
    """

    file: Annotated[tyro.conf.Positional[str], option("FILE.ply", "a splat file")]
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs

        with late_progress(console(True)) as progress:
            cloud = fs.load_ply(self.file, progress)
        facts = {"file": self.file, "bytes": Path(self.file).stat().st_size, **describe(cloud)}
        if self.json:
            print_json(facts)
            return 0
        print_table(console(False), self.file, ("", ""), _rows(facts))
        return 0


def describe(cloud: SplatCloud) -> dict[str, Any]:
    """A cloud in figures: metres as the file has them, percentiles of `SHARES`."""
    import numpy as np

    facts: dict[str, Any] = {
        "splats": len(cloud),
        "kind": "2D" if cloud.thickness is None else "3D",
        "sh_degree": max(cloud.sh_degree, 0),
        "left_out": dict(cloud.dropped),
    }
    if not len(cloud):
        return facts
    low, high = cloud.bounds()
    inner = np.percentile(cloud.means.astype(np.float64), (0.5, 99.5), axis=0) + cloud.origin
    extent = inner[1] - inner[0]
    up, sure = guess_up(cloud)
    axis = "xyz".index(up[1])
    scales = cloud.scales.astype(np.float64)
    return facts | {
        "bounds": [low, high],
        "middle_bounds": list(inner),
        "middle": inner.mean(0),
        "up": up,
        "up_share": sure,
        "height": float(extent[axis]),
        "marker_size": float(f"{0.1 * max(extent.max(), 1e-9):.1g}"),
        "scales": np.percentile(scales.max(1), SHARES),
        "aspect": float(np.median(scales.max(1) / scales.min(1))),
        "opacities": np.percentile(cloud.opacities, SHARES),
    }


def guess_up(cloud: SplatCloud) -> tuple[str, float]:
    """Which way is up, e.g. "-y", and the share of the splats' area that is level then, 0 to 1."""
    import numpy as np

    from fidsplat.rotations import quaternion_to_matrix

    normals = np.abs(quaternion_to_matrix(cloud.quats)[:, :, 2])
    area = cloud.scales.prod(1).astype(np.float64) * cloud.opacities
    area = np.minimum(area, np.percentile(area, 99))  # a sky of few huge splats is no ground
    level = normals > FLAT
    axis = int(np.argmax(area @ level))
    place = cloud.means[:, axis].astype(np.float64)
    low, high = np.percentile(place, (0.5, 99.5))
    some = level[:, axis] if level[:, axis].any() else np.ones(len(cloud), bool)
    ground = np.average(np.clip(place[some], low, high), weights=area[some] + 1e-30)
    return ("+" if ground <= (low + high) / 2 else "-") + "xyz"[axis], float(
        area @ level[:, axis] / max(area.sum(), 1e-300)
    )


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("splats", f"{facts['splats']:,} ({facts['kind']}), SH degree {facts['sh_degree']}"),
        ("file", f"{facts['bytes'] / 2**20:.1f} MiB"),
    ]
    rows += [("left out", f"{count:,}: {why}") for why, count in facts["left_out"].items()]
    if not facts["splats"]:
        return rows

    def point(values) -> str:
        return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"

    scales, opacities = (" / ".join(f"{v:.3g}" for v in facts[key]) for key in ("scales", "opacities"))
    shares = " / ".join(map(str, SHARES))
    low, high = facts["middle_bounds"]
    level = f"({100 * facts['up_share']:.0f} % of the area is level)"
    place = f"position = {point(facts['middle'])}: a tenth of the whole, in its middle"
    return [
        *rows,
        ("bounds", " to ".join(map(point, facts["bounds"])) + " m"),
        ("middle 99 %", f"{point(low)} to {point(high)} m, around {point(facts['middle'])}"),
        ("up", f"{facts['up']}? {level}, {facts['height']:.3g} m high"),
        ("longer scale", f"{scales} m at {shares} %; {facts['aspect']:.2g} times the shorter (median)"),
        ("opacity", f"{opacities} at {shares} %"),
        ("a first marker", f"size = {facts['marker_size']:g}, {place}"),
    ]
