"""Measure the errors of the depth cameras on a wall, by distance, incidence and reflectance.

python benchmarks/depth_cameras.py [NAME ...] [--device opencl] [--json FILE]

The error is the RMS distance along z from a fitted plane, over the middle 120 x 120 pixels without the 0.5 %
largest and smallest distances, as in librealsense's depth-quality tool; the bias is the error of the mean
depth. `published` is the published curve from which the parameters were derived.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.sim.depth_cameras import PRESETS, depth_camera
from fidsplat.util.response import to_colors

DISTANCES = (0.5, 0.8, 1.0, 1.5, 2.0, 3.0, 3.8)
TILTS = (30, 50, 60, 70, 80)
GREYS = (0.3, 0.1, 0.03)
MIDDLE = 60
"""half edge of the measured square in pixels"""


def kinect_v1(z: float, tilt: float = 0.0) -> float:
    """Khoshelham and Elberink 2012; for oblique walls, 10 to 60 degrees, Nguyen et al. 2012."""
    angle = math.radians(tilt)
    if not tilt:
        return 1.425e-3 * z * z
    oblique = 1e-4 / math.sqrt(z) * (angle / (math.pi / 2 - angle)) ** 2
    return 1.2e-3 + 1.9e-3 * (z - 0.4) ** 2 + oblique if 10 <= tilt <= 60 else math.nan


PUBLISHED: dict[str, Callable[..., float]] = {
    # 0.08 pixels of disparity (A. Grunnet-Jepsen, librealsense issue 3904)
    "d435": lambda z, tilt=0: math.nan if tilt else z * z * 0.08 / (424 * 0.05),
    # add_kinect_azure_noise of DLR-RM/BlenderProc, which cites Toelgyessy et al. 2021
    "azure-kinect": lambda z, tilt=0: math.nan if tilt else 0.5e-3 + 1e-3 * (z - 0.5),
    "kinect-v1": kinect_v1,
}
"""published standard deviation in metres by distance in metres and tilt in degrees"""


def wall(z: float, grey: float = 0.9, tilt: float = 0.0) -> fs.Scene:
    """A wall at a distance in metres, rotated about the vertical by some degrees."""
    turn = [math.cos(math.radians(tilt) / 2), 0, math.sin(math.radians(tilt) / 2), 0]
    color = to_colors(np.full((1, 3), grey), "srgb")
    return fs.Scene([fs.SplatCloud([[0, 0, z]], [turn], [[8.0, 8.0]], [1.0], colors=color).with_boxes()])


def errors(depth: np.ndarray, z: float) -> tuple[float, float, float]:
    """Fraction of measured pixels, RMS distance from the fitted plane in metres, and bias in metres."""
    h, w = depth.shape
    y, x = np.mgrid[h // 2 - MIDDLE : h // 2 + MIDDLE, w // 2 - MIDDLE : w // 2 + MIDDLE]
    found = depth[y, x].astype(np.float64)
    valid = found > 0
    if valid.sum() < 100:
        return float(valid.mean()), math.nan, math.nan
    known = np.column_stack([x[valid], y[valid], np.ones(valid.sum())])
    inverse = known @ np.linalg.lstsq(known, 1 / found[valid], rcond=None)[0]
    error = np.sort(found[valid] - 1 / inverse)
    rms = np.sqrt(np.mean(error[len(error) // 200 : -len(error) // 200] ** 2))
    return float(valid.mean()), float(rms), float(found[valid].mean() - z)


def main() -> None:
    parser = options(__doc__, repeats=1)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"default all of {', '.join(PRESETS)}")
    arguments = parser.parse_args()
    renderer = fs.Renderer(arguments.device)
    cases = [{"z": z} for z in DISTANCES]
    cases += [{"z": 1.5, "tilt": tilt} for tilt in TILTS] + [{"z": 1.5, "grey": grey} for grey in GREYS]
    rows = []
    for name in arguments.names or PRESETS:
        device, camera = depth_camera(name)
        for case in cases:
            share, rms, bias = errors(device.measure(renderer, wall(**case), camera), case["z"])
            plain = set(case) == {"z"}
            row = {"camera": name, "case": " ".join(f"{key} {value:g}" for key, value in case.items())}
            row |= {"measured": share, "rms_mm": rms * 1e3, "bias_mm": bias * 1e3 if plain else math.nan}
            row["published_mm"] = math.nan if "grey" in case else PUBLISHED[name](**case) * 1e3
            rows.append(facts(renderer) | row)
    if keep(rows, arguments.json):
        return

    def text(value: float, digits: int) -> str:
        return "" if math.isnan(value) else f"{value:.{digits}f}"

    show(
        "{device}, {date}: a wall of reflectance 0.9 unless stated".format(**rows[0]),
        ("camera", "case", "measured", "rms [mm]", "published [mm]", "bias [mm]"),
        (
            (
                row["camera"],
                row["case"],
                f"{row['measured']:.2f}",
                text(row["rms_mm"], 2),
                text(row["published_mm"], 2),
                text(row["bias_mm"], 2),
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
