"""Measure `fidsplat capture` on photographs with known cameras: errors of scale, gravity and cameras.

    python benchmarks/photographs.py -o /tmp/photographs [--count 16] [--size 640 480] [--seed 0]
    python benchmarks/photographs.py -o /tmp/photographs --cycles 8 --iterations 1500 --size 480 360

Renders the greenhouse with texture on the floor, the bench and a wall, through a lens with distortion and
fx != fy, with noise and changes of exposure, as photos/*.jpg with the cameras in truth.json; runs the command
on them, and prints the errors as a row of a table. With --cycles, Blender renders the greenhouse as a mesh
room with a sun, a ceiling of light and two bounces (`fidsplat experiment blender --install` before).
--iterations also trains at the poses of the capture, with refinement, and at the true poses, and localises
the held-out photographs.
"""

import argparse
import json
import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import fidsplat as fs
from fidsplat.cameras import BrownConrady
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.capture.sensor import Sensor
from fidsplat.experiments.blender import default_environment, image_job, ready, run_worker
from fidsplat.images.files import encode_image, read_image, to_uint8, write_png
from fidsplat.splats.rotations import nearest_rotation, quaternion_to_matrix, rigid_matrix
from fidsplat.train import Dataset, Trainer, TrainingView, load_dataset
from fidsplat.train.masks import undistorted_view
from fidsplat.train.view_refinement import alignment, moved
from fidsplat.util.response import linear_light, to_colors
from fidsplat.vision.pose import pose_error
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
    for tag in (0.9, 2.7):  # keep the tags uncovered
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
    scene, renderer, found = textured(house, rng), fs.Renderer(), {}
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


def textured(house: Greenhouse, rng: np.random.Generator) -> fs.Scene:
    """The greenhouse with texture, without the roof, whose posts are between the bench and the cameras."""
    clouds = (*house.scene.clouds[:3], texture(rng, 4000))
    return fs.Scene(clouds, markers=house.scene.markers, background=house.scene.background)


def take_video(folder: Path, count: int, size: tuple[int, int], seed: int, readout: float) -> dict:
    """Render a video of 10 frames per second of a camera that is carried along the bench, with the sway of a
    hand; returns the truth. readout: seconds of a rolling shutter."""
    house, rng = Greenhouse(rows=1, plants=6, seed=seed), np.random.default_rng(seed)
    scene, renderer, found, phases = textured(house, rng), fs.Renderer(), {}, rng.uniform(0, 6, 8)
    width, height = size

    def camera(time: float) -> fs.Camera:
        share = 10 * time / count
        sway = np.sin(2 * math.pi * time * np.array([0.9, 0.7, 1.6, 0.8, 1.1, 0.6]) + phases[:6])
        x, y, z, across, up, roll = sway * (0.03, 0.03, 0.015, 0.05, 0.04, 0.03)
        bob = 0.25 * math.sin(2.2 * time)
        position = (0.3 + 3 * share + x, -1.5 - 0.3 * math.sin(math.pi * share) + y, 0.6 + bob + z)
        target, above = (1.5 + 0.6 * share + across, 0, 0.55 + up), (math.sin(roll), 0, math.cos(roll))
        pose = fs.Camera.look_at(width, height, 1.0, position, target, above).world_to_camera
        f = 0.78 * width
        return fs.Camera.pinhole(width, height, f, f, width / 2, height / 2, pose, lens=LENS)

    folder.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(folder / "photos.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, size)
    for i in range(count):
        own = camera(i / 10)
        capture = fs.Capture(own, sensor=Sensor(full_well=8000, read_noise=8, seed=i))
        if readout:
            motion = fs.Motion(camera=lambda time, begin=i / 10: camera(begin + time).world_to_camera)
            capture = capture.with_(motion=motion, shutter=fs.Shutter(readout=readout))
        frame = renderer.render(scene, capture).to_uint8()
        video.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        found[f"frame-{i:06d}.jpg"] = own.world_to_camera.tolist()
    video.release()
    return {"cameras": found, "tags": {tag.marker.spec: tag.pose.tolist() for tag in house.markers}}


def _by_hand(camera: fs.Camera, rng: np.random.Generator):
    """Motion (world_to_camera) of a camera that moves sideways and rotates."""
    speed, turn = rng.normal(0, 0.3, 3), rng.normal(0, 0.12, 3)

    def pose(time: float) -> np.ndarray:
        moved = rigid_matrix(speed * time, (1, *(turn * time / 2)))
        return moved @ camera.world_to_camera

    return pose


def mesh_of(clouds, rng: np.random.Generator) -> dict:
    """Disks as octagons of 1.5 standard deviations, up to 2 mm in front of each other, and surfaces behind
    them: floor, wall, and a bench as a box."""
    corners, faces, albedo = [], [], []
    angles = np.arange(8) * math.pi / 4
    for cloud in clouds:
        axes = quaternion_to_matrix(cloud.quats)
        u, v, normal = (axes[:, :, k] * s for k, s in enumerate((*cloud.scales.T[:, :, None] * 1.5, 0.002)))
        ring = np.cos(angles)[None, :, None] * u[:, None] + np.sin(angles)[None, :, None] * v[:, None]
        off = rng.uniform(0, 1, (len(cloud), 1)) * normal * np.sign(-normal @ (0, 1, -0.5))[:, None]
        corners.append((cloud.world_means()[:, None] + off[:, None] + ring).reshape(-1, 3))
        colors = cloud.colors if cloud.colors is not None else cloud.plain_colors
        albedo.append(linear_light(np.clip(colors, 0, 1), "srgb"))
    count = sum(map(len, corners))
    faces = np.arange(count).reshape(-1, 8).tolist()
    boxes = (
        *(((-4, -6, -0.1), (8, 3, 0.0)), ((-4, 1.21, 0), (8, 1.3, 3)), ((0, -0.2, 0.0), (3.6, 0.2, 0.5))),
    )
    for low, high in boxes:
        box = np.array([[(low, high)[b][k] for k, b in enumerate(bits)] for bits in np.ndindex(2, 2, 2)])
        corners.append(box)
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        faces += [[count + k for k in side] for side in sides]
        albedo.append(np.full((6, 3), 0.35))
        count += 8
    return {
        "vertices": np.concatenate(corners).tolist(),
        "faces": faces,
        "albedo": np.concatenate(albedo).tolist(),
    }


def sheet_of(tag) -> dict:
    """Sheet of paper of a placed marker, for the Blender worker."""
    made = tag.marker
    half = np.array(made.grid.shape[::-1]) * made.module / 2
    at = np.array([(x, y, 0, 1) for y in (-half[1], half[1]) for x in (-half[0], half[0])])
    points = (at @ tag.pose.T)[:, :3].reshape(2, 2, 3).tolist()
    light = {"ink": 0.05, "paper": 0.85, "roughness": None, "emits": False, "smooth": False}
    return {"points": points, "grid": made.grid.tolist(), **light}


_INTRINSICS = ("fx", "fy", "cx", "cy")


def take_by_cycles(folder: Path, count: int, size: tuple[int, int], seed: int, samples: int) -> dict:
    """Photographs by Blender: pinhole images of 1.5 times the focal length, resampled through the lens, with
    noise of 8000 electrons and changes of exposure. Returns and writes the truth."""
    house, rng = Greenhouse(rows=1, plants=6, seed=seed), np.random.default_rng(seed)
    tags = [tag for tag in house.markers if tag.marker.spec in TAGS]
    mesh = mesh_of((house.scene.clouds[2], texture(rng, 4000)), rng)
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    given, images = cameras(count, *size, seed), []
    width, height, f = round(1.7 * size[0]), round(1.7 * size[1]), 1.5 * 0.78 * size[0]
    for i, camera in enumerate(given):
        wide = fs.Camera.pinhole(width, height, f, f, width / 2, height / 2, camera.world_to_camera)
        images.append(image_job(folder / "cycles" / f"{i:03d}.npy", wide))
    ceiling = {"corners": [(-4, -1, 3), (-4, 3, 3), (8, 3, 3), (8, -1, 3)], "radiance": (1.5, 1.5, 1.6)}
    sun = {"kind": "sun", "intensity": 2.5, "direction": (0.3, 0.6, -0.7), "angle": 0.03}
    room = {"name": "room", "panels": [ceiling], "lights": [sun], "mesh": mesh, "bounces": 2}
    room |= {"sheets": [sheet_of(tag) for tag in tags], "images": images}
    worker = Path(__file__).with_name("blender_room.py")
    job = {"samples": samples, "denoise": True}
    list(run_worker(ready("raw", default_environment()), worker, [room], job))
    y, x = np.mgrid[0 : size[1], 0 : size[0]] + 0.5
    for i, (camera, image) in enumerate(zip(given, images, strict=True)):
        rays = camera.rays(np.stack([x, y], -1).reshape(-1, 2))
        at = (f * rays[:, :2] / rays[:, 2:] + (width / 2 - 0.5, height / 2 - 0.5)).astype(np.float32)
        light = cv2.remap(np.load(image["file"]), at.reshape(*size[::-1], 2), None, cv2.INTER_LINEAR)
        electrons = 8000 * 0.7 * 2 ** rng.normal(0, 0.2) * np.maximum(light, 0)
        electrons = rng.poisson(electrons) + rng.normal(0, 8, light.shape)
        rgb = to_colors(np.clip(electrons / 8000, 0, 1), "srgb").astype(np.float32)
        (folder / "photos" / f"{i:03d}.jpg").write_bytes(encode_image(rgb, "jpeg", 95))
    found = {f"{i:03d}.jpg": camera.world_to_camera.tolist() for i, camera in enumerate(given)}
    truth = {"cameras": found, "tags": {tag.marker.spec: tag.pose.tolist() for tag in tags}}
    (folder / "truth.json").write_text(json.dumps(truth))
    return truth


def errors(scene: Path, truth: dict) -> dict[str, float]:
    """Errors of a capture: scale in percent, gravity in degrees, cameras (ATE) and tags in millimetres after
    a rigid alignment of the cameras, and angles of the cameras in degrees."""
    estimated = fs.load_cameras(scene.parent / "sparse" / "0")
    facts, rotation, shift = camera_errors(estimated, truth)
    tags = [
        np.linalg.norm(rotation @ tag.pose[:3, 3] + shift - np.array(truth["tags"][tag.marker.spec])[:3, 3])
        for tag in fs.Scene.load(_without_splats(scene)).markers
    ]
    return facts | {"tags_mm": 1000 * float(np.max(tags))}


def camera_errors(estimated: dict[str, fs.Camera], truth: dict) -> tuple[dict, np.ndarray, np.ndarray]:
    """Errors of cameras after a rigid alignment, with its rotation and translation."""
    true = {name: fs.Camera.pinhole(8, 8, 8, 8, 4, 4, np.array(truth["cameras"][name])) for name in estimated}
    names = sorted(estimated)
    found = np.array([estimated[name].position for name in names])
    known = np.array([true[name].position for name in names])
    a, b = found - found.mean(0), known - known.mean(0)
    rotation = nearest_rotation(b.T @ a)
    scale = float((a @ rotation.T * b).sum() / (a**2).sum())
    shift = known.mean(0) - rotation @ found.mean(0)
    apart = np.linalg.norm(found @ rotation.T + shift - known, axis=1)
    angles = []
    for name in names:
        delta = estimated[name].world_to_camera[:3, :3] @ rotation.T @ true[name].world_to_camera[:3, :3].T
        angles.append(math.degrees(math.acos(min(1, (np.trace(delta) - 1) / 2))))
    facts = {
        "registered": len(names),
        "scale_percent": 100 * (1 / scale - 1),
        "gravity_deg": math.degrees(math.acos(min(1, rotation[2, 2]))),
        "ate_mm": 1000 * float(np.sqrt((apart**2).mean())),
        "angle_deg": float(np.median(angles)),
    }
    return facts, rotation, shift


def true_dataset(options: argparse.Namespace, truth: dict, captured: Dataset) -> Dataset:
    """The photographs with true cameras, at the size of the capture's images, without the pixels of tags."""
    views, shown = {}, {view.name: view for view in (*captured.views, *captured.held_out)}
    for number, camera in enumerate(cameras(options.count, *options.size, options.seed)):
        name = f"{number:03d}.jpg"
        if name not in shown:
            continue
        mask = np.ones((camera.height, camera.width), np.uint8)
        for spec, pose in truth["tags"].items():
            corners = (np.array(fs.marker(spec, 0.24).corners) @ np.array(pose)[:3, :3].T) + np.array(pose)[
                :3, 3
            ]
            cv2.fillConvexPoly(mask, camera.project(corners).round().astype(int), 0)
        full = undistorted_view(name, camera, read_image(options.o / "photos" / name), mask > 0)
        to, share = shown[name].camera, shown[name].camera.width / camera.width
        numbers = (share * getattr(camera, key) for key in _INTRINSICS)
        small = fs.Camera.pinhole(to.width, to.height, *numbers, camera.world_to_camera)
        size = (to.width, to.height)
        inside = cv2.resize(full.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
        image = cv2.resize(full.image, size, interpolation=cv2.INTER_AREA)
        views[name] = TrainingView(name, small, image, inside)
    held = {view.name for view in captured.held_out}
    every = [view for view in (*captured.views, *captured.held_out)]
    matrix = alignment([view.camera for view in every], [views[view.name].camera for view in every])
    points = captured.points @ matrix[:3, :3].T + matrix[:3, 3]
    parts = ([view for name, view in views.items() if (name in held) == wanted] for wanted in (False, True))
    return Dataset("true", *map(tuple, parts), points, captured.colors, captured.background)


def train_all(options: argparse.Namespace, truth: dict) -> None:
    """Train with true and with estimated poses, with and without refinement; prints the PSNR of held-out
    views, the drift of the scale, and errors of localisation."""
    renderer, captured = fs.Renderer(), load_dataset(options.o / "scene", hold_out=4)
    # not the pixels of tags, which have the background's colour
    shown = (v.mask & (v.image != 255 * np.array(v.background)).any(axis=2) for v in captured.held_out)
    pairs = zip(captured.held_out, shown, strict=True)
    captured = replace(captured, held_out=tuple(replace(view, mask=mask) for view, mask in pairs))
    true = true_dataset(options, truth, captured)
    poses = {"refine_poses": True, "pose_rate": options.rate, "pose_rate_end": options.rate / 100}
    both = {**poses, "refine_intrinsics": True}
    print("| poses | PSNR, dB | SSIM | scale, % | drift, % | ATE, mm | angle, ° | focal, % | middle, px |")
    for name, dataset, refine in (
        *(("true", true, {}), ("of the capture", captured, {})),
        *(("refined", captured, poses), ("and intrinsics", captured, both)),
    ):
        trainer = Trainer(
            dataset, renderer, iterations=options.iterations, max_splats=20000, fit_exposures=True, **refine
        )
        trainer.run()
        scores = trainer.evaluate()
        row = [float(np.mean([getattr(score, key) for score in scores])) for key in ("psnr", "ssim")]
        facts, *_ = camera_errors({view.name: view.camera for view in trainer.views}, truth)
        drift = 0.0
        if refine:  # of the refined cameras as they are optimised
            drift = 1 / np.cbrt(np.linalg.det(trainer._refinement.to_dataset()[:3, :3])) - 1
        row += [facts["scale_percent"], 100 * drift, facts["ate_mm"], facts["angle_deg"]]
        one, exact = trainer.views[0].camera, true.views[0].camera
        row += [100 * (one.fx / exact.fx - 1), math.hypot(one.cx - exact.cx, one.cy - exact.cy)]
        print(f"| {name} | " + " | ".join(f"{value:.4g}" for value in row) + " |", flush=True)
        cloud, views = trainer.cloud(), trainer.views
        shown = renderer.render(cloud, dataset.held_out[0].camera, background=dataset.background)["rgb"]
        pair = np.hstack([dataset.held_out[0].image, to_uint8(shown)])
        write_png(options.o / f"held-out {name}.png".replace(" ", "-"), pair)
    ends = [{v.name: v.camera for v in each} for each in (views, true.views)]
    matrix = alignment([ends[0][name] for name in ends[1]], list(ends[1].values()))
    rng, offs = np.random.default_rng(1), []
    resident = renderer.upload(cloud)
    for view, exact in zip(captured.held_out, true.held_out, strict=True):
        motion = rng.normal(size=6) * np.repeat([math.radians(3), 0.06], 3)
        start = offset_camera(
            replace(view.camera, **{k: getattr(views[0].camera, k) for k in _INTRINSICS}), motion
        )
        found = fs.localise(view.image, resident, start, mask=view.mask, renderer=renderer)
        at = moved(start.with_pose(found.pose), matrix)
        offs.append((*pose_error(at.camera_to_world, exact.camera.camera_to_world), found.inliers))
    for distance, angle, inliers in offs:
        text = f"{1000 * distance:.3g} mm, {math.degrees(angle):.3g} degrees, {100 * inliers:.0f} % of blocks"
        print(f"localisation of a held-out photograph: {text}")


def _without_splats(scene: Path) -> Path:
    """Copy of the scene file without its splats, which this script does not train."""
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
    parser.add_argument("--video", action="store_true", help="a video of --count frames, 24 of them are used")
    parser.add_argument("--cycles", type=int, help="samples of Blender's Cycles, e.g. 32")
    parser.add_argument("--rate", type=float, default=5e-4, help="learning rate of poses")
    parser.add_argument("--iterations", type=int, default=0, help="train so many iterations")
    options = parser.parse_args()
    size = tuple(options.size)
    if options.cycles:
        truth = take_by_cycles(options.o, options.count, size, options.seed, options.cycles)
    elif options.video:
        truth = take_video(options.o, options.count, size, options.seed, options.readout)
    else:
        truth = take(options.o, options.count, size, options.seed, options.readout)
    scene, begun = options.o / "scene", time.perf_counter()
    source = options.o / ("photos.mp4" if options.video else "photos")
    command = ["capture", str(source), "--frames", "24", "-o", str(scene), "--overwrite", "--json"]
    command += [word for tag in TAGS for word in ("--tag", f"{tag}=0.16")]
    command += ["--up", TAGS[0]] if options.up else []
    command += ["--max-side", str(size[0] // 2)] if options.iterations else []
    done = subprocess.run([sys.executable, "-m", "fidsplat", *command], stdout=subprocess.PIPE, check=True)
    facts = json.loads(done.stdout)
    row = {"seed": options.seed, "photographs": options.count, "points": facts["points"]}
    row |= errors(scene / "scene.toml", truth)
    row |= {
        "standard_error_percent": 100 * facts["scale_standard_error"],
        "corners_px": facts["corner_rms_px"],
    }
    row |= {"readout_px": facts["readout_px"]}
    row |= {"reprojection_px": facts["reprojection_px"], "seconds": time.perf_counter() - begun}
    print("| " + " | ".join(row) + " |")
    print("| " + " | ".join(f"{value:.3g}" for value in row.values()) + " |", flush=True)
    if options.iterations:
        train_all(options, truth)


if __name__ == "__main__":
    main()
