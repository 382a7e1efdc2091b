"""`fidsplat capture` against photographs with known cameras: errors of scale, gravity and cameras.

    python benchmarks/photographs.py -o /tmp/photographs [--count 16] [--size 640 480] [--seed 0]

Renders the greenhouse with texture on the floor, the bench and a wall, through a lens with distortion and
fx != fy, with noise and changes of exposure, as photos/*.jpg with the cameras in truth.json; runs the command
on them, and prints the errors as a row of a table.
"""

import argparse
import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.cameras import BrownConrady
from fidsplat.capture.sensor import Sensor
from fidsplat.images.files import encode_image
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.worlds.greenhouse import Greenhouse
from fidsplat.worlds.plants import disks

LENS = BrownConrady(k1=-0.12, k2=0.03, p1=0.0004, p2=-0.0003)
TAGS = ("apriltag:36h11:2", "apriltag:36h11:4")


def cameras(count: int, width: int, height: int, seed: int = 0) -> list[fs.Camera]:
    """Hand-held cameras on an arc in front of the bench, at two heights, with some roll."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(count):
        share = i / (count - 1)
        position = (0.3 + 3.0 * share, -1.5 - 0.3 * math.sin(math.pi * share), 0.55 + 0.5 * (i % 2))
        target = (1.8 + 0.6 * (share - 0.5), 0.0, 0.55)
        position, target = (np.add(v, rng.normal(0, 0.04, 3)) for v in (position, target))
        roll = rng.normal(0, 0.04)
        pose = fs.Camera.look_at(width, height, 1.0, position, target, (math.sin(roll), 0, math.cos(roll)))
        f, cx, cy = 0.78 * width, width / 2 + 3, height / 2 - 2
        found.append(fs.Camera.pinhole(width, height, f, 1.004 * f, cx, cy, pose.world_to_camera, lens=LENS))
    return found


def texture(rng: np.random.Generator, count: int) -> fs.SplatCloud:
    """Small disks on the floor, on the side of the bench and on a wall behind it."""
    u, v = rng.uniform(-1, 1, (2, 3, count))
    floor = np.stack([1.8 + 3 * u[0], -1 + v[0], 0.004 + 0 * u[0]], 1)
    side = np.stack([1.8 + 1.8 * u[1], -0.203 + 0 * u[1], 0.24 + 0.24 * v[1]], 1)
    for tag in (0.9, 2.7):  # not on the tags
        side = side[np.abs(side[:, :2] - (tag, -0.2)).max(1) > 0.2]
    wall = np.stack([1.8 + 4 * u[2], 1.2 + 0 * u[2], 1.2 + 1.2 * v[2]], 1)
    axes = ((1, 0, 0), (0, 1, 0)), ((1, 0, 0), (0, 0, 1)), ((1, 0, 0), (0, 0, 1))
    clouds = []
    for centers, (first, second), size in zip((floor, side, wall), axes, (0.012, 0.008, 0.03), strict=True):
        angle = rng.uniform(0, math.pi, (len(centers), 1))
        one, two = np.array(first, float), np.array(second, float)
        along = np.cos(angle) * one + np.sin(angle) * two
        normals = np.broadcast_to(np.cross(one, two), along.shape)
        sizes = size * rng.uniform(0.3, 1, (len(centers), 2))
        clouds.append(disks(centers, along, normals, sizes, rng.uniform(0.05, 0.9, (len(centers), 3)), 0.95))
    return fs.SplatCloud.concatenate(clouds)


def take(folder: Path, count: int, size: tuple[int, int], seed: int, readout: float = 0.0) -> dict:
    """Render the photographs; returns and writes the truth.

    readout: seconds, of a camera that is moved by hand.
    """
    house, rng = Greenhouse(rows=1, plants=6, seed=seed), np.random.default_rng(seed)
    # without the roof, whose posts are between the bench and the cameras
    clouds = (*house.scene.clouds[:3], texture(rng, 4000))
    scene = fs.Scene(clouds, markers=house.scene.markers, background=house.scene.background)
    renderer, found = fs.Renderer(), {}
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    for i, camera in enumerate(cameras(count, *size, seed)):
        exposure = float(2 ** rng.normal(0, 0.2))
        sensor = Sensor(exposure=exposure, full_well=8000, read_noise=8, seed=i)
        capture = fs.Capture(camera, sensor=sensor)
        if readout:
            motion = fs.Motion(camera=_by_hand(camera, rng))
            capture = fs.Capture(camera, sensor=sensor, motion=motion, shutter=fs.Shutter(readout=readout))
        frame = renderer.render(scene, capture)
        (folder / "photos" / f"{i:03d}.jpg").write_bytes(encode_image(frame["rgb"], "jpeg", 95))
        found[f"{i:03d}.jpg"] = camera.world_to_camera.tolist()
    truth = {"cameras": found, "tags": {tag.marker.spec: tag.pose.tolist() for tag in house.markers}}
    (folder / "truth.json").write_text(json.dumps(truth))
    return truth


def _by_hand(camera: fs.Camera, rng: np.random.Generator):
    """world_to_camera at a time, of a camera that moves to the side and turns."""
    speed, turn = rng.normal(0, 0.3, 3), rng.normal(0, 0.12, 3)

    def pose(time: float) -> np.ndarray:
        moved = rigid_matrix(speed * time, (1, *(turn * time / 2)))
        return moved @ camera.world_to_camera

    return pose


def errors(scene: Path, truth: dict) -> dict[str, float]:
    """Errors of a capture: scale in percent, gravity in degrees, cameras (ATE) and tags in millimetres after
    a rigid alignment of the cameras, and angles of the cameras in degrees."""
    estimated = fs.load_cameras(scene.parent / "sparse" / "0")
    true = {name: fs.Camera.pinhole(8, 8, 8, 8, 4, 4, np.array(truth["cameras"][name])) for name in estimated}
    names = sorted(estimated)
    found = np.array([estimated[name].position for name in names])
    known = np.array([true[name].position for name in names])
    a, b = found - found.mean(0), known - known.mean(0)
    left, values, right = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.linalg.det(left @ right)])
    turn = left @ np.diag(signs) @ right
    scale = float((values * signs).sum() / (a**2).sum())
    shift = known.mean(0) - turn @ found.mean(0)
    apart = np.linalg.norm(found @ turn.T + shift - known, axis=1)
    angles = []
    for name in names:
        delta = estimated[name].world_to_camera[:3, :3] @ turn.T @ true[name].world_to_camera[:3, :3].T
        angles.append(math.degrees(math.acos(min(1, (np.trace(delta) - 1) / 2))))
    tags = [
        np.linalg.norm(turn @ tag.pose[:3, 3] + shift - np.array(truth["tags"][tag.marker.spec])[:3, 3])
        for tag in fs.Scene.load(_without_splats(scene)).markers
    ]
    return {
        "registered": len(names),
        "scale_percent": 100 * (1 / scale - 1),
        "gravity_deg": math.degrees(math.acos(min(1, turn[2, 2]))),
        "ate_mm": 1000 * float(np.sqrt((apart**2).mean())),
        "angle_deg": float(np.median(angles)),
        "tags_mm": 1000 * float(np.max(tags)),
    }


def _without_splats(scene: Path) -> Path:
    """The scene file without the splats, which are not trained here."""
    file = scene.with_name("tags.toml")
    file.write_text(scene.read_text().partition("[[splats]]")[0])
    return file


def main() -> None:
    """Take the photographs, run the command, print the errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", type=Path, required=True)
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--up", action="store_true", help="gravity by the first tag")
    parser.add_argument("--readout", type=float, default=0.0, help="seconds of a rolling shutter")
    options = parser.parse_args()
    truth = take(options.o, options.count, tuple(options.size), options.seed, options.readout)
    scene, begun = options.o / "scene", time.perf_counter()
    command = ["capture", str(options.o / "photos"), "-o", str(scene), "--overwrite", "--json"]
    command += [word for tag in TAGS for word in ("--tag", f"{tag}=0.16")]
    command += ["--up", TAGS[0]] if options.up else []
    done = subprocess.run([sys.executable, "-m", "fidsplat", *command], stdout=subprocess.PIPE, check=True)
    facts = json.loads(done.stdout)
    row = {"seed": options.seed, "photographs": options.count, "points": facts["points"]}
    row |= errors(scene / "scene.toml", truth)
    row |= {
        "standard_error_percent": 100 * facts["scale_standard_error"],
        "corners_px": facts["corner_rms_px"],
    }
    row |= {"reprojection_px": facts["reprojection_px"], "seconds": time.perf_counter() - begun}
    print("| " + " | ".join(row) + " |")
    print("| " + " | ".join(f"{value:.3g}" for value in row.values()) + " |")


if __name__ == "__main__":
    main()
