"""Check that this tree and a commit render bit-identical images.

    python benchmarks/compare_images.py COMMIT [--device D] [--only WORDS]

Renders 146 small frames (every lens, output, effect, preset and mixture, some within small memory budgets)
with both trees, each tree in its own process, and prints the names of the frames that differ. With cold
caches on two cores this takes about three minutes for each tree.
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
# Earlier commits use other names: `Shutter.exposure`, `SplatCloud.with_planes`, `Quality.setup_precision`.
_EXPOSURE_TIME = "exposure_time" if "exposure_time" in fs.Shutter.__dataclass_fields__ else "exposure"
_PROJECTION = "projection" if "projection_precision" in fs.Quality.__dataclass_fields__ else "setup"


def cloud(seed: int, count: int = 1500, degree: int | None = None, largest: float = 0.25) -> fs.SplatCloud:
    """Random splats in front of the camera, with plain colours or with SH of a degree."""
    rng = np.random.default_rng(seed)
    means = np.stack(
        [rng.uniform(-1.6, 1.6, count), rng.uniform(-1.1, 1.1, count), rng.uniform(0.6, 5, count)], 1
    )
    scales = np.exp(rng.uniform(math.log(largest / 25), math.log(largest), (count, 2)))
    terms = 1 if degree is None else (degree + 1) ** 2
    shades = rng.random((count, 3)) if degree is None else rng.normal(0, 0.4, (count, terms, 3))
    colors = {"colors" if degree is None else "sh": shades.astype(np.float32)}
    opacities, labels = rng.uniform(0.02, 1, count), np.arange(count, dtype=np.int32) // 300
    return fs.SplatCloud(means, rng.normal(size=(count, 4)), scales, opacities, labels=labels, **colors)


def in_coplanar_groups(splats: fs.SplatCloud) -> fs.SplatCloud:
    """The splats in coplanar groups of forty, except the first forty, which have no group."""
    groups = np.arange(len(splats)) // 40 - 1
    if hasattr(splats, "with_coplanar_groups"):
        return splats.with_coplanar_groups(groups)
    return splats.with_planes(groups)


def turning(time: float) -> np.ndarray:
    """Pose of a camera that rotates about its optical axis and moves sideways."""
    pose, angle = np.eye(4), 0.5 * time
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    pose[0, 3] = -0.2 * time
    return pose


def sliding(time: float) -> np.ndarray:
    """Pose of a group of splats that moves sideways."""
    pose = np.eye(4)
    pose[0, 3] = 0.4 * time
    return pose


def cameras() -> dict[str, fs.Camera]:
    """A camera for each lens model."""
    focal = (70.0, 71.0, 46.0, 31.0)
    return {
        "pinhole": fs.Camera.pinhole(WIDTH, HEIGHT, *focal),
        "distortion": fs.Camera.pinhole(WIDTH, HEIGHT, *focal, lens=fs.BrownConrady(-0.2, 0.05, p1=0.01)),
        "fisheye": fs.Camera.fisheye(WIDTH, HEIGHT, math.radians(170)),
        "equirectangular": fs.Camera.equirectangular(WIDTH, HEIGHT),
        "orthographic": fs.Camera.orthographic(WIDTH, HEIGHT, 3.2),
    }


def frames() -> dict[str, dict[str, Any]]:
    """Arguments of `Renderer.render` by frame name; `budget` is the renderer's memory budget."""
    found: dict[str, dict[str, Any]] = {}
    for name, camera in cameras().items():
        found |= {
            f"{name}: {words}": {"camera": camera, **given} for words, given in _for_each_lens().items()
        }
    pinhole = cameras()["pinhole"]
    found |= {f"output {name}": {"camera": pinhole, "outputs": (name,)} for name in OUTPUTS}
    grouped = in_coplanar_groups(cloud(8))
    for preset in ("standard", "fast", "reference", "gsplat", "surfel"):
        found[f"preset {preset}"] = {"camera": pinhole, "quality": preset}
        found[f"preset {preset}, coplanar groups"] = {
            "camera": pinhole,
            "quality": preset,
            "scene": grouped,
        }
    for words in (
        *("arithmetic=precise", "arithmetic=approximate"),
        *("blend_precision=float16", "blend_precision=float64"),
    ):
        found[words] = {"camera": pinhole, "quality": words, "outputs": OUTPUTS}
    single = f"{_PROJECTION}_precision=float32"
    found["projection in float32"] = {"camera": pinhole, "quality": single, "outputs": OUTPUTS}
    found |= {f"sensor {words}": {"camera": pinhole, "sensor": one} for words, one in _sensors().items()}
    for k in range(12):
        largest = 0.05 * (k + 1)
        found[f"splats up to {largest:.2f}"] = {
            "camera": pinhole,
            "scene": cloud(100 + k, 3000, largest=largest),
        }
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
        arguments = {"camera": large, "scene": cloud(11, 20000), "outputs": ("rgb", "alpha", "depth")}
        found[f"within {mib} MiB"] = arguments | {"budget": mib * MIB}
    return found


def _for_each_lens() -> dict[str, dict[str, Any]]:
    panorama = fs.Panorama(np.random.default_rng(5).random((16, 32, 3)).astype(np.float32))
    camera_motion, group_motion = fs.Motion(turning, {}), fs.Motion(None, {1: sliding})
    some, boxes = cloud(6, 300), cloud(5, 300).with_boxes()
    mixed = some.with_boxes(np.arange(len(some)) // 40 % 2 == 0)
    exposed = fs.Shutter(**{_EXPOSURE_TIME: 0.3}, sub_poses=2)
    return {
        "all outputs": {"outputs": OUTPUTS},
        "SH of degree 0": {"scene": cloud(4, degree=0), "outputs": OUTPUTS},
        "SH of degree 3": {"scene": cloud(3, 800, 3), "outputs": OUTPUTS},
        "boxes": {"scene": boxes, "outputs": OUTPUTS},
        "coplanar groups": {"scene": in_coplanar_groups(cloud(7)), "outputs": OUTPUTS},
        "coplanar groups and boxes": {"scene": in_coplanar_groups(mixed), "outputs": OUTPUTS},
        "lowpass=pixel": {"quality": "lowpass=pixel"},
        "lowpass=none": {"quality": "lowpass=none"},
        "samples=2": {"quality": "samples=2"},
        "fog": {"fog": fs.Fog(0.2, (0.6, 0.65, 0.7))},
        "gradient": {"background": fs.Gradient((0.2, 0.4, 0.9), (0.4, 0.3, 0.1))},
        "panorama": {"background": panorama},
        "blur": {"motion": camera_motion, "shutter": exposed, "outputs": OUTPUTS},
        "rolling": {"motion": camera_motion, "shutter": fs.Shutter(readout=0.4, rows_per_band=16)},
        "group": {"motion": group_motion, "shutter": fs.Shutter(time=0.7)},
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


def digests(device: str, only: str) -> dict[str, str]:
    """SHA-256 of each frame, or its error message, by frame name."""
    found, main, plain = {}, fs.Renderer(device), cloud(1)
    for name, given in frames().items():
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


def digests_of_tree(tree: Path, device: str, only: str) -> dict[str, str]:
    """Digests of the frames that the package of a tree renders, in a separate process."""
    path = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, __file__, "--this-process", "--device", device, "--only", only]
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
    parser.add_argument("--only", default="", help="only frames whose names contain this text")
    parser.add_argument("--this-process", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.this_process:
        print(json.dumps(digests(options.device, options.only)))
        return 0
    if options.commit is None:
        parser.error("name a commit, or a folder with its files")
    from before_after import ROOT, checked_out  # here, since another tree may lack these modules

    with tempfile.TemporaryDirectory() as folder:
        given = Path(options.commit).resolve()
        other = given if given.is_dir() else checked_out(options.commit, Path(folder))
        before, now = (digests_of_tree(tree, options.device, options.only) for tree in (other, ROOT))
    if not now:
        parser.error(f"--only must be part of a frame name, got {options.only!r}")
    both_refuse = [name for name in now if REFUSED in before[name] and REFUSED in now[name]]
    differ = [name for name in now if before[name] != now[name] and name not in both_refuse]
    for name in differ:
        errors = [text for text in (before[name], now[name]) if REFUSED in text]
        print(f"differs: {name}" + "".join(f"\n  {text}" for text in errors))
    same = len(now) - len(differ) - len(both_refuse)
    print(f"{len(now)} frames on {options.device}: {same} identical, {len(both_refuse)} refused by both")
    return 1 if differ else 0


if __name__ == "__main__":
    raise SystemExit(main())
