"""Whether two trees draw the same pictures, bit for bit: after a change that is to change none.

    python benchmarks/same_pictures.py COMMIT [--device D] [--only WORDS]

144 small frames, every lens, output, effect, preset and mixture, whole and in chunks and bands, by a commit
and by this tree, each in a process of its own; printed are those that differ. Three minutes for a tree with
cold caches, on two cores.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import fidsplat as fs

OUTPUTS = (
    *("rgb", "alpha", "depth", "depth_median", "depth_first", "distance", "distance_median"),
    *("distance_first", "normal", "normal_world", "label", "splat_id", "blended"),
)
WIDTH, HEIGHT = 93, 61
MIB = 1 << 20
REFUSED = "refused"
# shutters were told their exposure time by a shorter name once
_EXPOSURE_TIME = "exposure_time" if "exposure_time" in fs.Shutter.__dataclass_fields__ else "exposure"


def cloud(seed: int, count: int = 1500, degree: int | None = None, most: float = 0.25) -> fs.SplatCloud:
    """Random splats before the camera; of plain colours, or of SH of that degree."""
    rng = np.random.default_rng(seed)
    means = np.stack(
        [rng.uniform(-1.6, 1.6, count), rng.uniform(-1.1, 1.1, count), rng.uniform(0.6, 5, count)], 1
    )
    scales = np.exp(rng.uniform(math.log(most / 25), math.log(most), (count, 2)))
    terms = 1 if degree is None else (degree + 1) ** 2
    shades = rng.random((count, 3)) if degree is None else rng.normal(0, 0.4, (count, terms, 3))
    colours = {"colors" if degree is None else "sh": shades.astype(np.float32)}
    opacities, labels = rng.uniform(0.02, 1, count), np.arange(count, dtype=np.int32) // 300
    return fs.SplatCloud(means, rng.normal(size=(count, 4)), scales, opacities, labels=labels, **colours)


def printed(given: fs.SplatCloud) -> fs.SplatCloud:
    """Forty splats on each plane, the first forty on none."""
    return given.with_planes(np.arange(len(given)) // 40 - 1)


def turning(time: float) -> np.ndarray:
    """A camera that turns about its axis and moves aside."""
    pose, angle = np.eye(4), 0.5 * time
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    pose[0, 3] = -0.2 * time
    return pose


def sliding(time: float) -> np.ndarray:
    """A group of splats that moves aside."""
    pose = np.eye(4)
    pose[0, 3] = 0.4 * time
    return pose


def cameras() -> dict[str, fs.Camera]:
    """One of each lens."""
    focal = (70.0, 71.0, 46.0, 31.0)
    return {
        "pinhole": fs.Camera.pinhole(WIDTH, HEIGHT, *focal),
        "distortion": fs.Camera.pinhole(WIDTH, HEIGHT, *focal, lens=fs.BrownConrady(-0.2, 0.05, p1=0.01)),
        "fisheye": fs.Camera.fisheye(WIDTH, HEIGHT, math.radians(170)),
        "equirectangular": fs.Camera.equirectangular(WIDTH, HEIGHT),
        "orthographic": fs.Camera.orthographic(WIDTH, HEIGHT, 3.2),
    }


def pictures() -> dict[str, dict[str, Any]]:
    """Arguments of `Renderer.render` by the pictures' names; `budget` is the renderer's own."""
    found: dict[str, dict[str, Any]] = {}
    for name, camera in cameras().items():
        found |= {
            f"{name}: {words}": {"camera": camera, **given} for words, given in _through_a_lens().items()
        }
    pinhole = cameras()["pinhole"]
    found |= {f"output {name}": {"camera": pinhole, "outputs": (name,)} for name in OUTPUTS}
    for preset in ("standard", "fast", "reference", "gsplat", "surfel"):
        found[f"preset {preset}"] = {"camera": pinhole, "quality": preset}
        found[f"preset {preset}, planes"] = {"camera": pinhole, "quality": preset, "scene": printed(cloud(8))}
    for words in ("setup_precision=float32", "arithmetic=precise", "blend_precision=float64"):
        found[words] = {"camera": pinhole, "quality": words, "outputs": OUTPUTS}
    found |= {f"sensor {words}": {"camera": pinhole, "sensor": one} for words, one in _sensors().items()}
    for k in range(12):
        most = 0.05 * (k + 1)
        found[f"splats up to {most:.2f}"] = {"camera": pinhole, "scene": cloud(100 + k, 3000, most=most)}
    for spec in ("apriltag:36h11:5", "aruco:4x4_50:7", "qr:hello world"):
        for mixture in ("fitted", "paper", "exact"):
            for tilt in (0, 55):
                scene = fs.Scene([_placed(spec, mixture, tilt), cloud(9, 300)])
                found[f"{spec}, {mixture}, {tilt} degrees"] = {
                    "camera": pinhole,
                    "scene": scene,
                    "outputs": OUTPUTS,
                }
    large = fs.Camera.pinhole(640, 480, 480.0, 480.0, 320.0, 240.0)
    for mib in (18, 24, 40, 80):
        of = {"camera": large, "scene": cloud(11, 20000), "outputs": ("rgb", "alpha", "depth")}
        found[f"within {mib} MiB"] = of | {"budget": mib * MIB}
    return found


def _through_a_lens() -> dict[str, dict[str, Any]]:
    panorama = fs.Panorama(np.random.default_rng(5).random((16, 32, 3)).astype(np.float32))
    moving, of_group = fs.Motion(turning, {}), fs.Motion(None, {1: sliding})
    some, boxes = cloud(6, 300), cloud(5, 300).with_boxes()
    mixed = some.with_boxes(np.arange(len(some)) // 40 % 2 == 0)
    exposed = fs.Shutter(**{_EXPOSURE_TIME: 0.3}, sub_poses=2)
    return {
        "all outputs": {"outputs": OUTPUTS},
        "SH of degree 0": {"scene": cloud(4, degree=0), "outputs": OUTPUTS},
        "SH of degree 3": {"scene": cloud(3, 800, 3), "outputs": OUTPUTS},
        "boxes": {"scene": boxes, "outputs": OUTPUTS},
        "planes": {"scene": printed(cloud(7)), "outputs": OUTPUTS},
        "planes of both kinds": {"scene": printed(mixed), "outputs": OUTPUTS},
        "lowpass=pixel": {"quality": "lowpass=pixel"},
        "lowpass=none": {"quality": "lowpass=none"},
        "samples=2": {"quality": "samples=2"},
        "fog": {"fog": fs.Fog(0.2, (0.6, 0.65, 0.7))},
        "gradient": {"background": fs.Gradient((0.2, 0.4, 0.9), (0.4, 0.3, 0.1))},
        "panorama": {"background": panorama},
        "blur": {"motion": moving, "shutter": exposed, "outputs": OUTPUTS},
        "rolling": {"motion": moving, "shutter": fs.Shutter(readout=0.4, rows_per_band=16)},
        "group": {"motion": of_group, "shutter": fs.Shutter(time=0.7)},
    }


def _sensors() -> dict[str, fs.Sensor]:
    each: dict[str, dict[str, Any]] = {
        "exposure": {"exposure": 1.5},
        "vignetting": {"vignetting": (-0.3, 0.05)},
        "noise": {"full_well": 1000.0, "read_noise": 3.0, "seed": 4},
        "gain": {"gain": 0.5},
        "gamma": {"response": 2.2},
        "table": {"response": (0.0, 0.9, 1.0)},
        "bits": {"bits": 8},
        "srgb": {"response": "srgb"},
    }
    together = {name: value for one in each.values() for name, value in one.items()}
    return {name: fs.Sensor(**given) for name, given in {**each, "all": together}.items()}


def _placed(spec: str, mixture: str, tilt: float) -> fs.SplatCloud:
    pose, angle = np.eye(4), math.radians(tilt)
    pose[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    pose[2, 3] = 0.9
    return fs.marker(spec, size=0.5, mixture=mixture).cloud.transformed(pose)


def draw(device: str, only: str) -> dict[str, str]:
    """A hash of each picture, or what its error says, by their names."""
    found, main, plain = {}, fs.Renderer(device), cloud(1)
    for name, given in pictures().items():
        if only not in name:
            continue
        given = {
            "scene": plain,
            "outputs": ("rgb", "alpha", "depth", "label"),
            "background": (0.1, 0.2, 0.3),
            **given,
        }
        budget = given.pop("budget", None)
        try:
            renderer = main if budget is None else fs.Renderer(device, memory_budget=budget)
            scene = given.pop("scene")
            scene = scene.cloud() if isinstance(scene, fs.Scene) else scene
            frame = renderer.render(scene, **given)
            bits = b"".join(np.ascontiguousarray(frame[one]).tobytes() for one in given["outputs"])
            found[name] = hashlib.sha256(bits).hexdigest()
        except (fs.InputError, fs.DeviceError) as error:
            found[name] = f"{REFUSED}: {error}"
    return found


def drawn_by(tree: Path, device: str, only: str) -> dict[str, str]:
    """`draw` with the package of a tree."""
    path = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, __file__, "--drawn-here", "--device", device, "--only", only]
    done = subprocess.run(
        words, stdout=subprocess.PIPE, cwd=tree, env=os.environ | {"PYTHONPATH": path}, check=True
    )
    return json.loads(done.stdout)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commit", nargs="?", help="any name that git knows, or a folder with its files")
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--only", default="", help="pictures whose names have these words")
    parser.add_argument("--drawn-here", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.drawn_here:
        print(json.dumps(draw(asked.device, asked.only)))
        return 0
    if asked.commit is None:
        parser.error("name a commit, or a folder with its files")
    from before_after import ROOT, checked_out  # late: another tree's package need not have what it takes

    with tempfile.TemporaryDirectory() as folder:
        given = Path(asked.commit).resolve()
        other = given if given.is_dir() else checked_out(asked.commit, Path(folder))
        before, now = (drawn_by(tree, asked.device, asked.only) for tree in (other, ROOT))
    if not now:
        parser.error(f"no picture has {asked.only!r} in its name")
    refused = [name for name in now if REFUSED in before[name] and REFUSED in now[name]]
    differ = [name for name in now if before[name] != now[name] and name not in refused]
    for name in differ:
        said = [text for text in (before[name], now[name]) if REFUSED in text]
        print(f"differs: {name}" + "".join(f"\n  {text}" for text in said))
    same = len(now) - len(differ) - len(refused)
    print(
        f"{len(now)} pictures on {asked.device}: {same} with the same bits, {len(refused)} that both refuse"
    )
    return 1 if differ else 0


if __name__ == "__main__":
    raise SystemExit(main())
