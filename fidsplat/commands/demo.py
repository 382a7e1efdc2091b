"""`fidsplat demo`."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from fidsplat.commands.output import Device, Json, console, option, print_json, print_table, say

if TYPE_CHECKING:
    from fidsplat.experiments.demo import DemoResult, Sighting


@dataclass
class Demo:
    """The main job, end to end, with pictures and a table.

    Makes an AprilTag, an ArUco tag and a QR code of splats, sets them in a yard of some ten thousand splats,
    draws three views with colour, depth, normals and labels, and reads them back. Exit status 1 when a marker
    that is wholly visible is not found within 1 % of its distance.

    Examples:
      fidsplat demo
      fidsplat demo --mixture fitted --out soft
      fidsplat demo --out pictures --json
    """

    out: Annotated[
        str, option("DIR", "folder for pictures, scene and figures (default: fidsplat-demo)", "-o")
    ] = "fidsplat-demo"
    device: Device = None
    mixture: Annotated[
        str, option("NAME", "of the markers: exact, fitted or paper, as `fidsplat marker` (default: exact)")
    ] = "exact"
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.demo import run_demo

        where = console(self.json)
        with where.status("starting") as status:
            result = run_demo(self.out, self.device, status.update, self.mixture)
        if self.json:
            print_json(result.as_dict())
        else:
            heads = ("view", "marker", "seen", "found", "mm", "%", "deg", "splats", "ms")
            rows = (_row(s, result) for s in result.sightings)
            print_table(where, f"fidsplat demo on {result.device}", heads, rows)
            where.print(
                "seen: how much of it is in view. Errors: position in mm and in % of the distance, angle in "
                "degrees. ms: a frame with colour, depth, normals and labels."
            )
            markers = sum(result.marker_splats.values())
            say(
                where,
                f"{result.background_splats:,} background and {markers:,} marker splats; "
                f"{result.seconds:.1f} s in all; pictures in {self.out}/contact-sheet.png",
            )
        if not result.passed:
            missed = [
                f"{s.reading.placed.marker.spec} in '{s.view}'" for s in result.sightings if s.passed is False
            ]
            say(where, "failed: " + "; ".join([*missed, *(f"read {s}" for s in result.unexpected)]))
        return 0 if result.passed else 1


def _row(sighting: "Sighting", result: "DemoResult") -> tuple[str, ...]:
    reading = sighting.reading
    spec = reading.placed.marker.spec
    errors = ("-", "-", "-")
    if reading.position_error is not None and reading.angle_error is not None:
        share = 100 * reading.position_error / reading.distance
        angle = math.degrees(reading.angle_error)
        errors = (f"{reading.position_error * 1e3:.1f}", f"{share:.2f}", f"{angle:.2f}")
    return (
        sighting.view,
        spec,
        f"{100 * reading.visible:.0f} %",
        "no" if reading.detection is None else "yes",
        *errors,
        str(result.marker_splats[spec]),
        f"{result.frame_ms[sighting.view]:.1f}",
    )
