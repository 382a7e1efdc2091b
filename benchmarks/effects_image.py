"""What each effect of the picture costs: footprints, low-passes, colours, outputs, sensor, fog, backgrounds.

    python benchmarks/effects_image.py [--scene r1m_1080p] [--device opencl] [--repeats 5] [--only NAME ...]

Every frame with an effect is followed by one without, splats resident, picture left on the device, the queue
drained before and after each. The price is the median of the ratios of the two times less 1; the quartiles of
the ratios say how far to trust it. Boxes have the places, turns and scales of the scene's Gaussians and cover
less of the picture.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from datetime import date

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import fidsplat as fs
from fidsplat.effects import OUTPUTS
from fidsplat.experiments.scenes import SCENES, load_scene

TABLE = tuple(np.linspace(0, 1, 64) ** 0.5)
WHOLE = fs.Sensor(1.3, (-0.3, 0.05), 12000, 8, 1, 1.5, "srgb", 8)
SENSORS = {
    "exposure": fs.Sensor(exposure=1.3),
    "vignetting": fs.Sensor(vignetting=(-0.3, 0.05)),
    "noise": fs.Sensor(full_well=12000, read_noise=8),
    "gain": fs.Sensor(gain=1.5),
    "response gamma": fs.Sensor(response=2.2),
    "response srgb": fs.Sensor(response="srgb"),
    "response table": fs.Sensor(response=TABLE),
    "8 bits": fs.Sensor(bits=8),
    "whole sensor": WHOLE,
}


def variants() -> dict[str, dict]:
    """Name of an effect -> what differs from the base in the call of `Renderer.render`."""
    sky = np.random.default_rng(0).uniform(0, 1, (512, 1024, 3)).astype(np.float32)
    return {
        "base again": {},
        "lowpass none": {"quality": fs.Quality(lowpass="none")},
        "lowpass pixel": {"quality": fs.Quality(lowpass="pixel")},
        "boxes": {"cloud": "box"},
        "1 box in 100": {"cloud": "mixed"},
        **{f"SH degree {degree}": {"cloud": degree} for degree in (1, 2, 3)},
        **{f"output {name}": {"outputs": ("rgb", name)} for name in OUTPUTS if name != "rgb"},
        "fog": {"fog": fs.Fog(0.05)},
        "background gradient": {"background": fs.Gradient((0.2, 0.4, 0.9), (0.3, 0.3, 0.2))},
        "background panorama": {"background": fs.Panorama(sky)},
        **{name: {"sensor": sensor} for name, sensor in SENSORS.items()},
    }


def changed(cloud: fs.SplatCloud, what: str | int) -> fs.SplatCloud:
    """The scene's cloud with another footprint, or with SH of a degree."""
    if what == "box":
        return cloud.with_boxes()
    if what == "mixed":
        return cloud.with_boxes(np.arange(len(cloud)) % 100 == 0)
    count = (int(what) + 1) ** 2
    sh = np.random.default_rng(1).normal(0, 0.2, (len(cloud), count, 3)).astype(np.float32)
    return fs.SplatCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, sh=sh)


def milliseconds(renderer: fs.Renderer, resident, camera: fs.Camera, **call) -> float:
    """Wall time of one frame."""
    start = time.perf_counter()
    frame = renderer.render(resident, camera, **call)
    _ = frame.timings  # waits for the device
    return (time.perf_counter() - start) * 1e3


def measure(options: argparse.Namespace) -> list[dict]:
    """One row for each effect."""
    renderer = fs.Renderer(options.device)
    cloud, camera = load_scene(options.scene)
    base = renderer.upload(cloud)
    milliseconds(renderer, base, camera)
    chosen = {name: call for name, call in variants().items() if not options.only or name in options.only}
    rows = []
    for name, call in track(chosen.items(), "effects", console=Console(stderr=True)):
        what = call.pop("cloud", None)
        resident = base if what is None else renderer.upload(changed(cloud, what))
        milliseconds(renderer, resident, camera, **call)
        pairs = [
            (milliseconds(renderer, resident, camera, **call), milliseconds(renderer, base, camera))
            for _ in range(options.repeats)
        ]
        ratios = [mine / plain for mine, plain in pairs]
        quartiles = statistics.quantiles(ratios, n=4)
        rows.append(
            {
                "effect": name,
                "frame_ms": statistics.median(mine for mine, _ in pairs),
                "base_ms": statistics.median(plain for _, plain in pairs),
                "price_percent": (statistics.median(ratios) - 1) * 100,
                "quartiles_percent": [(quartiles[0] - 1) * 100, (quartiles[2] - 1) * 100],
            }
        )
    about = {
        "scene": options.scene,
        "device": renderer.device.title,
        "driver": renderer.device.version,
        "date": date.today().isoformat(),
        "repeats": options.repeats,
    }
    return [about | row for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="r1m_1080p", choices=list(SCENES))
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--repeats", type=int, default=5, help="2 or more")
    parser.add_argument("--only", nargs="*", default=[], choices=list(variants()), metavar="NAME")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    options.repeats = max(options.repeats, 2)
    rows = measure(options)
    if options.json:
        json.dump(rows, sys.stdout, indent=1)
        print()
        return
    title = "{scene}, {device}, {driver}, {date}, {repeats} pairs".format(**rows[0])
    table = Table("effect", "frame [ms]", "base [ms]", "price", "quartiles", title=title)
    for row in rows:
        low, high = row["quartiles_percent"]
        table.add_row(
            row["effect"],
            f"{row['frame_ms']:.1f}",
            f"{row['base_ms']:.1f}",
            f"{row['price_percent']:+.0f} %",
            f"{low:+.0f} to {high:+.0f} %",
        )
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
