"""Measure what shapes and wear of markers cost: splats, time to make them, and frame times.

Frames alternate with those of flat, new markers.

python benchmarks/marker_shapes.py [--device opencl] [--repeats 7] [--json FILE]

Nine AprilTags of 16 cm fill an image of 1280 x 720.
"""

from __future__ import annotations

import numpy as np
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.markers import BentSheet, BoxEdge, Cone, Crumpled, Cylinder, Wear
from fidsplat.scenes import PlacedMarker
from fidsplat.util.timing import frame_timer, quartiles, ratios, time_interleaved

SIZE = 0.16
CASES = {
    "flat": {},
    "cylinder, radius 60 mm": {"shape": Cylinder(0.06)},
    "cone, radius 90 mm": {"shape": Cone(0.09, 0.4)},
    "bent sheet, radius 50 mm": {"shape": BentSheet(0.05, 0.15)},
    "box edge, radius 6 mm": {"shape": BoxEdge(0.006)},
    "crumpled, height 9 mm": {"shape": Crumpled(0.009, 0.09)},
    "fading 0.5": {"wear": Wear(fading=0.5)},
    "dirt 0.3": {"wear": Wear(dirt=0.3)},
    "scratches 0.2": {"wear": Wear(scratches=0.2)},
    "drops 0.3": {"wear": Wear(drops=0.3)},
    "dirt 0.3 on the cylinder": {"wear": Wear(dirt=0.3), "shape": Cylinder(0.06)},
}


def scene_of(settings: dict) -> fs.Scene:
    """Nine tags with these settings, side by side."""
    tags = []
    for number in range(9):
        pose = np.eye(4)
        pose[:2, 3] = 0.22 * (number % 3 - 1), 0.22 * (number // 3 - 1)
        tags.append(PlacedMarker(fs.marker(f"apriltag:36h11:{number}", SIZE, **settings), pose))
    camera = fs.Camera.look_at(1280, 720, 1.0, (0.3, -0.2, -0.7), (0, 0, 0))
    return fs.Scene(markers=tags, camera=camera)


def main() -> None:
    arguments = options(__doc__, repeats=7).parse_args()
    renderer = fs.Renderer(arguments.device)
    scenes = {name: scene_of(settings) for name, settings in CASES.items()}
    camera, flat = scenes["flat"].camera, renderer.upload(scenes["flat"].cloud())
    rows = []
    for name, scene in scenes.items():
        base, mine = (
            frame_timer(renderer, cloud, camera) for cloud in (flat, renderer.upload(scene.cloud()))
        )
        time_interleaved([mine, base], max(arguments.repeats, 2))
        made = scene.markers[5].marker
        low, middle, high = quartiles([100 * (ratio - 1) for ratio in ratios(mine, base)])
        row = {"marker": name, "splats": len(made.cloud), "make_ms": made.seconds * 1e3}
        row |= {"base_ms": base.median, "frame_ms": mine.median, "price_percent": middle}
        rows.append(facts(renderer) | row | {"quartiles_percent": [low, high]})
    if keep(rows, arguments.json):
        return
    show(
        "{device}, {driver}, {date}, nine tags at 1280 x 720".format(**rows[0]),
        ("marker", "splats", "made in [ms]", "frame [ms]", "price", "quartiles"),
        (
            (
                row["marker"],
                f"{row['splats']:,}",
                f"{row['make_ms']:.0f}",
                f"{row['frame_ms']:.2f}",
                f"{row['price_percent']:+.0f} %",
                "{:+.0f} to {:+.0f} %".format(*row["quartiles_percent"]),
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
