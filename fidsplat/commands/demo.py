"""Command `fidsplat demo`: markers in a scene, rendered and detected."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from fidsplat.commands.options import Device, Json
from fidsplat.commands.output import (
    console,
    delayed_progress,
    print_json,
    print_lines,
    print_table,
    report,
    steps_shown,
)
from fidsplat.experiments.demo_views import DemoViewSettings

if TYPE_CHECKING:
    from fidsplat.experiments.demo import DemoResult, Sighting


@dataclass
class DemoViews:
    """Write the demo's scene as a data set for training: images, cameras, points.

    The folder has COLMAP's layout: DIR/images, DIR/sparse/0, and test views in DIR/test. Any trainer of
    splats reads it.

    Examples:
      fidsplat demo views -o yard && fidsplat train yard -o yard.ply --iterations 2000
      fidsplat demo views -o yard --views 60 --width 640
    """

    out: str = "fidsplat-demo-views"
    """DIR: folder for the data set"""
    images: DemoViewSettings = field(default_factory=DemoViewSettings)
    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.demo_views import write_demo_views

        with delayed_progress() as progress:
            folder = write_demo_views(self.out, self.images, self.device, progress)
        return report(self.json, {"folder": str(folder)}, f"{self.images.views} training views in {folder}")


@dataclass
class Demo:
    """Make markers, render them in a scene and detect them, with images and a table.

    Makes an AprilTag, an ArUco tag and a QR code of splats, places them in a yard of ten thousand splats,
    renders three views with colour, depth, normals and labels, and detects the markers in them. Then it adds
    views of a captured scene, biker (PlayCanvas, MIT, 2.5 MB), if the download ends before the other views
    are rendered. The exit status is 1 if a completely visible marker is not located within 1 % of its
    distance.

    Examples:
      fidsplat demo
      fidsplat demo --mixture fitted --out soft
      fidsplat demo --captured playbot                  another captured scene, in its own light
      fidsplat demo --out images --json
      fidsplat demo views -o yard                       the scene as a data set for training
    """

    PARTS: ClassVar[dict[str, type]] = {"views": DemoViews}

    out: str = "fidsplat-demo"
    """DIR: folder for images, scene and table"""
    device: Device = None
    mixture: str = "exact"
    """NAME: mixture of the markers: exact, fitted, facets or paper"""
    captured: str | None = None
    """NAME: captured scene of `fidsplat fetch`: biker or playbot, after its download, or none"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.demo import run_demo

        where = console(self.json)
        with steps_shown(where, "starting") as update:
            result = run_demo(self.out, self.device, update, self.mixture, self.captured)
        if self.json:
            print_json(result.as_dict())
        else:
            heads = ("view", "marker", "visible", "found", "mm", "%", "deg", "splats", "ms")
            rows = (_row(s, result) for s in result.sightings)
            print_table(where, f"fidsplat demo on {result.device}", heads, rows)
            where.print(
                "visible: fraction of the marker in view. Errors: position in mm and in % of the distance, "
                "angle "
                "in degrees. ms: time of a frame with colour, depth, normals and labels."
            )
            markers = sum(result.marker_splats.values())
            print_lines(
                where,
                f"{result.background_splats:,} background and {markers:,} marker splats; "
                f"{result.seconds:.1f} s in total; images in {self.out}/contact-sheet.png",
                f"captured scene: {result.captured}",
            )
        if not result.passed:
            missed = [
                f"{s.reading.placed.marker.spec} in '{s.view}'" for s in result.sightings if s.passed is False
            ]
            print_lines(where, "failed: " + "; ".join([*missed, *(f"read {s}" for s in result.unexpected)]))
        return 0 if result.passed else 1


def _row(sighting: "Sighting", result: "DemoResult") -> tuple[str, ...]:
    reading = sighting.reading
    spec = reading.placed.marker.spec
    errors = ("-", "-", "-")
    if reading.position_error is not None and reading.angle_error is not None:
        percent = 100 * reading.position_error / reading.distance
        angle = math.degrees(reading.angle_error)
        errors = (f"{reading.position_error * 1e3:.1f}", f"{percent:.2f}", f"{angle:.2f}")
    return (
        sighting.view,
        spec,
        f"{100 * reading.visible:.0f} %",
        "no" if reading.detection is None else "yes",
        *errors,
        str(result.marker_splats[spec]),
        f"{result.frame_ms[sighting.view]:.1f}",
    )
