"""Measure the cost of each effect: a random scene with and without it, interleaved, splats uploaded.

    python benchmarks/effects.py [NAME ...] [--scene r1m_1080p] [--device opencl] [--repeats 5] [--json FILE]
    python benchmarks/effects.py --table FILE.json [FILE.json ...]       the table of devlog/effect-prices.md

Frames with and without the effect alternate, the images stay on the device, and the queue is drained before
and after each frame, so that disturbances affect both. The cost is the median ratio of the two times, minus
1. The quartiles of the ratios, and the row "base again" with equal frames, show the uncertainty. Boxes have
the positions, rotations and scales of the scene's Gaussians and cover fewer pixels.
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from rich.progress import track

import fidsplat as fs
from fidsplat.effects import OUTPUTS
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.scenes import PlacedMarker
from fidsplat.scenes.random_clouds import SCENES, load_scene
from fidsplat.util.timing import frame_timer, quartiles, ratios, time_interleaved

TABLE = tuple(np.linspace(0, 1, 64) ** 0.5)
SENSORS = {
    "exposure": fs.Sensor(exposure=1.3),
    "vignetting": fs.Sensor(vignetting=(-0.3, 0.05)),
    "noise": fs.Sensor(full_well=12000, read_noise=8),
    "gain": fs.Sensor(gain=1.5),
    "response gamma": fs.Sensor(response=2.2),
    "response srgb": fs.Sensor(response="srgb"),
    "response table": fs.Sensor(response=TABLE),
    "8 bits": fs.Sensor(bits=8),
    "decode srgb": fs.Sensor(decode="srgb"),
    "veiling glare": fs.Sensor(veiling_glare=0.1, glare_light=(0.2, 0.2, 0.2)),
    "saturation": fs.Sensor(saturation=0.8),
    "white balance": fs.Sensor(white_balance=(0.9, 1.0, 1.2)),
    "auto-exposure": fs.Sensor(auto_exposure=0.18),
    "whole sensor": fs.Sensor(1.3, (-0.3, 0.05), 12000, 8, 1, 1.5, "srgb", 8),
}


def turning(time: float) -> np.ndarray:
    """Pose of a camera that rotates by 30 degrees per second."""
    angle = math.radians(30) * time
    return fs.Camera.look_at(2, 2, 1.0, (0, 0, 0), (math.sin(angle), 0, math.cos(angle))).world_to_camera


def moved(time: float) -> np.ndarray:
    """Pose of a group that moves to the right at 1 m/s."""
    matrix = np.eye(4)
    matrix[0, 3] = time
    return matrix


def lenses(base: fs.Camera) -> dict[str, dict]:
    """The base camera with each lens."""

    def through(lens, narrower: float = 1.0) -> dict:
        focal = narrower * base.fx, narrower * base.fy
        camera = fs.Camera.pinhole(base.width, base.height, *focal, base.cx, base.cy, lens=lens)
        return {"camera": camera}

    return {
        "distortion": through(fs.BrownConrady(-0.28, 0.07, p1=1e-3)),
        # the same field of view across the middle row
        "fisheye": through(fs.Fisheye(0.01), math.tan(math.radians(30)) / math.radians(30)),
        "panorama": {"camera": fs.Camera.equirectangular(base.width, base.height)},
        "parallel rays": {"camera": fs.Camera.orthographic(base.width, base.height, 9.2)},
    }


def shutters() -> dict[str, dict]:
    """Arguments of `Renderer.render` for motions and shutters."""
    turn = fs.Motion(turning)
    return {
        # every tenth splat
        "moving group": {"motion": fs.Motion(None, {1: moved}), "shutter": fs.Shutter(time=0.1)},
        "blur, 8 poses": {"motion": turn, "shutter": fs.Shutter(exposure_time=0.02)},
        "rolling, bands of 64 rows": {
            "motion": turn,
            "shutter": fs.Shutter(readout=0.02, rows_per_band=64),
        },
        "rolling, bands of 8 rows": {"motion": turn, "shutter": fs.Shutter(readout=0.02)},
        "blur, 8 poses, and rolling, bands of 64 rows": {
            "motion": turn,
            "shutter": fs.Shutter(exposure_time=0.01, readout=0.02, rows_per_band=64),
        },
    }


def effects(base: fs.Camera) -> dict[str, dict]:
    """Arguments of `Renderer.render` that differ from the base, by effect; `cloud` is an argument of
    `changed`."""
    sky = np.random.default_rng(0).uniform(0, 1, (512, 1024, 3)).astype(np.float32)
    return {
        "base again": {},
        **lenses(base),
        **shutters(),
        "lowpass none": {"quality": TIMED.with_(lowpass="none")},
        "lowpass pixel": {"quality": TIMED.with_(lowpass="pixel")},
        "2 x 2 samples": {"quality": TIMED.with_(samples=2)},
        "boxes": {"cloud": "box"},
        "1 box in 100": {"cloud": "mixed"},
        **{f"boxes, {name}": {**lens, "cloud": "box"} for name, lens in lenses(base).items()},
        **{f"SH degree {degree}": {"cloud": degree} for degree in (1, 2, 3)},
        **{f"output {name}": {"outputs": ("rgb", name)} for name in OUTPUTS if name != "rgb"},
        "output error": {"outputs": ("rgb", "error"), "quality": TIMED.with_(order="centre")},
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


def measure(names: list[str], scene: str, device: str, repeats: int) -> list[dict]:
    """One row for each effect."""
    renderer = fs.Renderer(device)
    cloud, camera = load_scene(scene)
    cloud = cloud.with_labels((np.arange(len(cloud)) % 10 == 0).astype(np.int32))
    plain = renderer.upload(cloud)
    known = effects(camera)
    rows = []
    for name in track(names or list(known), "effects", console=PROGRESS):
        call = {"camera": camera, **known[name]}
        what = call.pop("cloud", None)
        resident = plain if what is None else renderer.upload(changed(cloud, what))
        base = frame_timer(renderer, plain, camera, quality=TIMED)
        mine = frame_timer(renderer, resident, **{"quality": TIMED, **call})
        time_interleaved([mine, base], repeats)
        low, middle, high = quartiles([100 * (ratio - 1) for ratio in ratios(mine, base)])
        rows.append(
            {
                "effect": name,
                "base_ms": base.median,
                "effect_ms": mine.median,
                "price_percent": middle,
                "quartiles_percent": [low, high],
            }
        )
    about = {"scene": scene, **facts(renderer), "repeats": repeats}
    return [about | row for row in rows]


LIGHTS: dict[str, dict] = {
    "light: 1 panorama": {"light": fs.Lighting(panoramas=1)},
    "light: 3 x 3 panoramas": {"light": fs.Lighting(panoramas=3)},
    "light: sun": {"light": fs.Lighting("lights"), "lights": [fs.Sun(direction=(0, 0.3, 1))]},
    "light: gloss, any view": {"light": fs.Lighting(panoramas=1, roughness=0.5)},
    "light: gloss, camera": {"light": fs.Lighting(panoramas=1, roughness=0.25, view="camera")},
}
"""light on one marker; computed when a scene is uploaded, not for each frame"""


def measure_light(names: list[str], scene: str, device: str, repeats: int) -> list[dict]:
    """Seconds to compute the light of an AprilTag in the scene, after a run that compiles kernels."""
    renderer = fs.Renderer(device)
    cloud, camera = load_scene(scene)
    tag, pose = fs.marker("apriltag:36h11:5", size=0.16), np.eye(4)
    pose[:3, 3] = (0, 0, 1)
    rows = []
    for name in track([one for one in LIGHTS if one in names or not names], "light", console=PROGRESS):
        parts = dict(LIGHTS[name])
        placed = PlacedMarker(tag, pose, light=parts.pop("light"))
        times = []
        for _ in range(repeats + 1):
            start = time.perf_counter()
            lit = renderer.lit(fs.Scene([cloud], camera, [placed], background=(0.5, 0.5, 0.5), **parts))
            times.append(time.perf_counter() - start)
        low, middle, high = quartiles(times[1:])
        splats = len(lit.markers[0].marker.cloud)
        rows.append({"effect": name, "seconds": middle, "quartiles": [low, high], "splats": splats})
    about = {"scene": scene, **facts(renderer), "repeats": repeats}
    return [about | row for row in rows]


def page_table(files: list[str]) -> str:
    """Markdown table of the results of several devices, from files of --json."""
    runs = [{row["effect"]: row for row in json.loads(Path(file).read_text("utf-8"))} for file in files]
    firsts = [next(iter(run.values())) for run in runs]
    head = "".join(f" {first['device']}, {first['repeats']} pairs | |" for first in firsts)
    lines = [f"| effect |{head}", "|---|" + "---:|---:|" * len(runs)]
    for name in runs[0]:
        cells = [name]
        for row in (run.get(name) for run in runs):
            low, high = row["quartiles_percent"] if row else (0, 0)
            cells += (
                [f"{row['effect_ms']:.4g} ms", f"{row['price_percent']:+.0f} % ({low:+.0f} to {high:+.0f})"]
                if row
                else ["", ""]
            )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, repeats=5)
    known = [*effects(fs.Camera.pinhole(8, 8, 8, 8, 4, 4)), *LIGHTS]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"default all of: {', '.join(known)}")
    parser.add_argument("--scene", default="r1m_1080p", choices=list(SCENES))
    parser.add_argument("--table", nargs="+", metavar="FILE", help="print results side by side instead")
    arguments = parser.parse_args()
    if arguments.table:
        print(page_table(arguments.table))
        return
    if unknown := set(arguments.names) - set(known):
        parser.error(f"no effect is called {', '.join(sorted(unknown))}; there are: {', '.join(known)}")
    how = arguments.scene, arguments.device, max(arguments.repeats, 2)
    frames = [name for name in arguments.names if name not in LIGHTS]
    rows = measure(frames, *how) if frames or not arguments.names else []
    lights = measure_light(arguments.names, *how) if len(frames) < len(arguments.names) or not frames else []
    if lights and arguments.json != "-":
        show(
            "{scene}, {device}, {driver}, {date}, {repeats} times".format(**lights[0]),
            ("light of a tag", "computed once in [s]", "quartiles", "splats"),
            (
                (
                    row["effect"],
                    f"{row['seconds']:.2f}",
                    "{:.2f} to {:.2f}".format(*row["quartiles"]),
                    str(row["splats"]),
                )
                for row in lights
            ),
        )
    if keep([*rows, *lights], arguments.json) or not rows:
        return
    show(
        "{scene}, {device}, {driver}, {date}, {repeats} pairs".format(**rows[0]),
        ("effect", "base [ms]", "with it [ms]", "price", "quartiles"),
        (
            (
                row["effect"],
                f"{row['base_ms']:.2f}",
                f"{row['effect_ms']:.2f}",
                f"{row['price_percent']:+.0f} %",
                "{:+.0f} to {:+.0f} %".format(*row["quartiles_percent"]),
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
