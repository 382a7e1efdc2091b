"""`fidsplat info`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from fidsplat.commands.declarations import option
from fidsplat.commands.options import Json
from fidsplat.commands.output import delayed_progress, report

if TYPE_CHECKING:
    from fidsplat.splats.cloud import SplatCloud

SHARES = (1, 50, 99)
"""percent"""

FLAT = 0.94
"""cosine of 20 degrees, the largest angle between an axis and the normal of a level splat"""


@dataclass
class Info:
    """Describe a splat file: number, kind and bounds of its splats.

    Bounds are those of all splats, and of the middle 99 % of their centres along each axis, as captures have
    strays far away. The up axis is a guess: away from the level areas, or along a side that is by far the
    longest. The command suggests a size for a first marker and a position at which `fidsplat render FILE.ply`
    shows it.

    Examples:
      fidsplat info scene.ply
      fidsplat info scene.ply --json
    """

    file: Annotated[
        tyro.conf.Positional[str], option("FILE", "PLY, .splat, SPZ, glTF or USD file, or a store")
    ]
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.commands.store import report_store
        from fidsplat.store.layout import SUFFIX

        if Path(self.file).suffix.lower() == SUFFIX:
            return report_store(self.file, self.json)
        with delayed_progress() as progress:
            cloud = fs.load_splats(self.file, progress)
        facts = {"file": self.file, "bytes": Path(self.file).stat().st_size, **describe(cloud)}
        return report(self.json, facts, table=(self.file, ("", ""), _rows(facts)))


def describe(cloud: SplatCloud) -> dict[str, Any]:
    """Figures of a cloud: lengths in the file's metres, percentiles of `SHARES`."""
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
    up, why = guess_up(cloud)
    axis = "xyz".index(up[1])
    scales = cloud.scales.astype(np.float64)
    return facts | {
        "bounds": [low, high],
        "middle_bounds": list(inner),
        "marker_position": [*inner.mean(0)[:2], inner[0, 2]],
        "up": up,
        "up_because": why,
        "height": float(extent[axis]),
        "marker_size": float(f"{0.1 * max(extent.max(), 1e-9):.1g}"),
        "scales": np.percentile(scales.max(1), SHARES),
        "aspect": float(np.median(scales.max(1) / scales.min(1))),
        "opacities": np.percentile(cloud.opacities, SHARES),
    }


def guess_up(cloud: SplatCloud) -> tuple[str, str]:
    """The up axis, for example "-y", and the reason: away from the level areas, or along a side that is by
    far the longest."""
    import numpy as np

    from fidsplat.splats.rotations import quaternion_to_matrix

    level = np.abs(quaternion_to_matrix(cloud.quats)[:, :, 2]) > FLAT
    area = cloud.scales.prod(1).astype(np.float64) * cloud.opacities
    area = (
        np.minimum(area, np.percentile(area, 99)) + 1e-30
    )  # a few huge splats of a sky must not count as ground
    low, high = np.percentile(cloud.means.astype(np.float64), (0.5, 99.5), axis=0)
    shares, sides = area @ level / area.sum(), np.sort(high - low)
    axis = int(np.argmax(shares))
    if shares[axis] < 0.5 and sides[2] > 1.5 * sides[1]:
        axis = int(np.argmax(high - low))
        return ("+x", "-y", "+z")[axis], "the longest side"
    some = level[:, axis] if level[:, axis].any() else np.ones(len(cloud), bool)
    place = np.clip(cloud.means[some, axis], low[axis], high[axis])
    below = np.average(place, weights=area[some]) <= (low[axis] + high[axis]) / 2
    return ("+" if below else "-") + "xyz"[axis], f"{100 * shares[axis]:.0f} % of the area is level"


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
    place = (
        f"position = {point(facts['marker_position'])}: a tenth of the scene, in front of its middle from -z"
    )
    return [
        *rows,
        ("bounds", " to ".join(map(point, facts["bounds"])) + " m"),
        ("middle 99 %", f"{point(low)} to {point(high)} m"),
        ("up", f"{facts['up']}? ({facts['up_because']}), {facts['height']:.3g} m high"),
        ("longer scale", f"{scales} m at {shares} %; {facts['aspect']:.2g} times the shorter (median)"),
        ("opacity", f"{opacities} at {shares} %"),
        ("a first marker", f"size = {facts['marker_size']:g}, {place}"),
    ]
