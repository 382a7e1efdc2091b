"""Whether depth over a marker is the printed plane's: an AprilTag of 0.16 m before a wall, 1280 x 720.

    python benchmarks/marker_depth.py [--device opencl] [--mixtures exact fitted facets] [--json FILE]

A wall that faces the camera stands 2 m or 5 cm behind the tag's middle, or 5 cm behind its furthest edge
where a tilted one would pass through it; tilts of 0 to 80 degrees, 0.3 to 6 m away. Of all pixels inside the
outline, quiet zone included, less one pixel: how far `depth` and `depth_median` are from where the ray meets
the plane, computed here in float64: the mean in mm, and the largest.
"""

from __future__ import annotations

import math

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from rich.progress import track

import fidsplat as fs
from fidsplat.markers import Marker

WIDTH, HEIGHT, FOV = 1280, 720, math.radians(60)
DISTANCES = (0.3, 0.6, 1.0, 2.0, 4.0, 6.0)
TILTS = range(0, 81, 10)
BEHIND = (2.0, 0.05)
"""metres from the tag to the wall"""
OUTPUTS = ("depth", "depth_median")


def wall(depth: float) -> fs.SplatCloud:
    """An opaque sheet as large as the picture and more, `depth` metres before a camera at the origin."""
    grey = np.full((1, 3), 0.4, np.float32)
    cloud = fs.SplatCloud([[0, 0, depth]], [[1, 0, 0, 0]], [[2 * depth, 2 * depth]], [1.0], colors=grey)
    return cloud.with_boxes().with_planes(0)


def facing(tag: Marker, distance: float, tilt: float) -> np.ndarray:
    """(4, 4) marker to camera: `distance` metres away, turned by `tilt` degrees about its horizontal axis."""
    c, s = math.cos(math.radians(tilt)), math.sin(math.radians(tilt))
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    pose[2, 3] = distance
    return pose


def plane_depth(pose: np.ndarray, half: float, camera: fs.Camera) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) depth of the plane at pixels' centres, and whether they are inside the outline less a pixel."""
    x = (np.arange(WIDTH) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(HEIGHT)[:, None] + 0.5 - camera.cy) / camera.fy
    normal, middle = pose[:3, 2], pose[:3, 3]
    z = normal @ middle / (normal[0] * x + normal[1] * y + normal[2])
    inside = np.ones(z.shape, bool)
    corners = [[-half, -half], [half, -half], [half, half], [-half, half]]
    outline = camera.project(np.array([[*corner, 0.0] for corner in corners]) @ pose[:3, :3].T + middle)
    px, py = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, 0), strict=True):
        away = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
        inside &= away >= math.hypot(bx - ax, by - ay)
    return z, inside


def errors(renderer: fs.Renderer, mixture: str, behind: float) -> dict:
    """Of all views with a wall `behind` the tag."""
    tag = fs.marker("apriltag:36h11:0", size=0.16, mixture=mixture)
    half = tag.grid.shape[0] * tag.module / 2
    sums, largest, count = dict.fromkeys(OUTPUTS, 0.0), dict.fromkeys(OUTPUTS, 0.0), 0
    camera = fs.Camera.pinhole(WIDTH, HEIGHT, *[WIDTH / 2 / math.tan(FOV / 2)] * 2, WIDTH / 2, HEIGHT / 2)
    for distance in DISTANCES:
        for tilt in TILTS:
            pose = facing(tag, distance, tilt)
            behind_tag = wall(distance + max(behind, half * math.sin(math.radians(tilt)) + 0.05))
            scene = fs.SplatCloud.concatenate([tag.cloud.transformed(pose), behind_tag])
            frame = renderer.render(scene, camera, OUTPUTS)
            truth, inside = plane_depth(pose, half, camera)
            count += int(inside.sum())
            for name in OUTPUTS:
                error = np.abs(np.nan_to_num(frame[name], posinf=1e3)[inside] - truth[inside])
                sums[name] += float(error.sum())
                largest[name] = max(largest[name], float(error.max()))
    row = {"mixture": mixture, "behind_m": behind, "pixels": count}
    for name in OUTPUTS:
        row |= {f"{name}_mean_mm": 1e3 * sums[name] / count, f"{name}_largest_mm": 1e3 * largest[name]}
    return row


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--mixtures", nargs="+", default=["exact", "fitted", "facets"])
    asked = parser.parse_args()
    renderer = fs.Renderer(asked.device)
    cases = [(mixture, behind) for mixture in asked.mixtures for behind in BEHIND]
    rows = [errors(renderer, *case) for case in track(cases, "walls", console=PROGRESS)]
    if keep(facts(renderer) | {"rows": rows}, asked.json):
        return
    heads = (
        "marker",
        "wall behind",
        "pixels",
        *(f"{name} {what}, mm" for name in OUTPUTS for what in ("mean", "largest")),
    )
    cells = [
        (
            row["mixture"],
            f"{row['behind_m']:g} m",
            str(row["pixels"]),
            *(f"{row[f'{name}_{what}_mm']:.3g}" for name in OUTPUTS for what in ("mean", "largest")),
        )
        for row in rows
    ]
    show(renderer.device.title, heads, cells)


if __name__ == "__main__":
    main()
