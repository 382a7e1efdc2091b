"""`fidsplat demo`."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from fidsplat.commands.output import (
    Device,
    Json,
    console,
    late_progress,
    option,
    print_json,
    print_table,
    say,
    tell,
)
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.experiments.demo import DemoResult, Sighting


@dataclass
class DemoViews:
    """The demo's scene as a data set to train on: pictures from many places, cameras, points.

    COLMAP's layout: DIR/images, DIR/sparse/0, and views to compare with in DIR/test; any trainer of splats
    reads it.

    Examples:
      fidsplat demo views -o yard && fidsplat train yard -o yard.ply --iterations 2000
      fidsplat demo views -o yard --views 60 --width 640
    """

    out: Annotated[str, option("DIR", "folder for the data set (default: fidsplat-demo-views)", "-o")] = (
        "fidsplat-demo-views"
    )
    views: Annotated[int, option("N", "pictures to train on, 2 to 1000 (default: 30)")] = 30
    width: Annotated[int, option("PIXELS", "of a picture, 64 to 4096 (default: 320)")] = 320
    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.demo_views import write_demo_views

        if not 2 <= self.views <= 1000:
            raise InputError(f"--views is {self.views}; give 2 to 1000")
        if not 64 <= self.width <= 4096:
            raise InputError(f"--width is {self.width}; give 64 to 4096 pixels")
        with late_progress(console(True)) as progress:
            folder = write_demo_views(
                self.out, self.views, width=self.width, device=self.device, progress=progress
            )
        return tell(self.json, {"folder": str(folder)}, f"{self.views} views to train on in {folder}")


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
      fidsplat demo views -o yard                       its scene as a data set to train on
    """

    PARTS: ClassVar[dict[str, type]] = {"views": DemoViews}

    out: Annotated[
        str, option("DIR", "folder for pictures, scene and figures (default: fidsplat-demo)", "-o")
    ] = "fidsplat-demo"
    device: Device = None
    mixture: Annotated[
        str,
        option(
            "NAME", "of the markers: exact, fitted, facets or paper, as `fidsplat marker` (default: exact)"
        ),
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
