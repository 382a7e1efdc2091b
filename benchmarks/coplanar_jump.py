"""How far a pixel jumps when a camera turns about a marker in steps of 1e-4 degrees, and when the marker's
splats are re-ordered.

    python benchmarks/coplanar_jump.py [--device opencl] [-o docs/images/coplanar-jump.png] [--json FILE]

"order" composites a marker's splats by the depth of their centres, as other renderers do and fidsplat does
with Quality(coplanar="order"); "blend" draws them as one layer. 20 steps about the view in which centres
change places; 240 x 192 pixels. The last rows are of an AprilTag 5 cm before a wall of 2000 splats of no
plane, in steps of 1e-3 degrees; what moves there under "blend" is the wall's own order. The picture shows the
QR code face to face before and after the worst step.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from rich.progress import track

import fidsplat as fs
from fidsplat.hard_cases.agreement import draw
from fidsplat.hard_cases.c_order import STEP, WALL_STEP, largest_jump, turning, wall
from fidsplat.hard_cases.clouds import taken
from fidsplat.vision.images import to_uint8, write_png
from fidsplat.vision.paint import contact_sheet

SPECS = {
    "AprilTag 36h11": "apriltag:36h11:5",
    "ArUco 4x4": "aruco:4x4_50:7",
    "QR 5": "qr-v5-L:fidsplat",
    "AprilTag, wall": "apriltag:36h11:5",
}
TILTS = (0.0, 30.0, 60.0)
MODES = ("centre", "pixel")
SIZE = {"width": 240, "height": 192}


def measure(renderer: fs.Renderer, name: str, panels: dict) -> list[dict]:
    """Jumps of one marker; the worst face to face goes to `panels`."""
    cloud, step = fs.marker(SPECS[name], size=1.0, mixture="fitted").cloud, STEP
    if name.endswith("wall"):
        cloud, step = fs.SplatCloud.concatenate([cloud, wall()]), WALL_STEP
    shuffled = taken(cloud, np.random.default_rng(0).permutation(len(cloud)))
    rows = []
    for tilt in TILTS:
        row = {"marker": name, "splats": len(cloud), "tilt_deg": tilt}
        for mode in MODES:
            jump, before, after = largest_jump(renderer, turning(cloud, mode, 10, tilt, **SIZE, step=step))
            first = next(turning(cloud, mode, 0, tilt, **SIZE))
            again = next(turning(shuffled, mode, 0, tilt, **SIZE))
            change = np.abs(draw(renderer, first)["rgb"] - draw(renderer, again)["rgb"]).max()
            row[f"step_{mode}"], row[f"shuffle_{mode}"] = jump, float(change)
            if tilt == 0:
                panels[name, mode] = (jump, before, after)
        rows.append(row)
    return rows


def picture(panels: dict) -> np.ndarray:
    """Before, after and the difference of both modes, (h, w, 3) uint8."""
    rows = []
    for mode in MODES:
        jump, before, after = panels["QR 5", mode]
        titled = (
            (f"order={mode}", before),
            ("turned by 0.0001 degrees", after),
            (f"difference, at most {jump:.2g}", np.abs(after - before)),
        )
        # the code's middle, each pixel three wide
        crop = np.s_[48:144, 72:168]
        rows.append(
            [(title, to_uint8(image[crop]).repeat(3, axis=0).repeat(3, axis=1)) for title, image in titled]
        )
    return contact_sheet(rows, width=288)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("-o", "--out", type=Path, help="PNG file for the picture")
    asked = parser.parse_args()
    renderer = fs.Renderer(asked.device)
    panels: dict = {}
    markers = track(SPECS, "markers", console=PROGRESS)
    rows = [row for name in markers for row in measure(renderer, name, panels)]
    if asked.out is not None:
        write_png(asked.out, picture(panels))
    if keep({**facts(renderer), "rows": rows}, asked.json):
        return

    def cells(row: dict) -> tuple[str, ...]:
        jumps = (row[f"{what}_{mode}"] for what in ("step", "shuffle") for mode in MODES)
        return row["marker"], str(row["splats"]), f"{row['tilt_deg']:g}", *(f"{jump:.1e}" for jump in jumps)

    heads = ("marker", "splats", "tilt", "step, order", "step, blend", "shuffled, order", "shuffled, blend")
    show(f"Largest jump of a pixel on {renderer.device.title}", heads, map(cells, rows))


if __name__ == "__main__":
    main()
