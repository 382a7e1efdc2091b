"""Measure accuracy, time and covariance of `fs.localise` in the greenhouse, from random initial poses.

    python benchmarks/localisation.py --repeats 100 [--distance 0.1 --degrees 5] [--noise 0.01] [--max-side N]

Photographs are rendered images with another exposure for each channel, noise and 8 bits. Prints median
errors, the share of poses within 20 mm, processor and wall time, and the mean of the squared errors
normalised by the covariance, which is 6 for a calibrated covariance.
"""

import math
import time

import numpy as np
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.localisation.direct_alignment import MAX_SIDE
from fidsplat.vision.pose import pose_error
from fidsplat.worlds.greenhouse import Greenhouse

WIDTH, HEIGHT, FOV_X = 640, 480, math.radians(70)
FAILED = 0.02
"""metres from which a pose counts as lost"""


def main() -> None:
    parser = options(__doc__, repeats=100)
    parser.add_argument("--distance", type=float, default=0.1, help="metres from the truth to the start")
    parser.add_argument("--degrees", type=float, default=5.0, help="angle from the truth to the start")
    parser.add_argument("--noise", type=float, default=0.01, help="standard deviation, display values")
    parser.add_argument("--change", type=float, default=0.0, help="change of the splats' colours, as a share")
    parser.add_argument("--max-side", type=int, default=MAX_SIDE, help="pixels of the finest level")
    words = parser.parse_args()
    scene, renderer = Greenhouse(3, 6).scene, fs.Renderer(words.device)
    resident = renderer.upload(scene)
    photographed = renderer.upload(changed(scene, words.change)) if words.change else resident
    rows = []
    for number in range(-1, words.repeats):  # the first is not counted
        random = np.random.default_rng(max(number, 0))
        camera = camera_at_random(random)
        start = offset_camera(
            camera, np.concatenate([radius(random, math.radians(words.degrees)), np.zeros(3)])
        )
        start = start.with_pose(position=camera.position + radius(random, words.distance))
        image = photograph(
            renderer.render(photographed, camera, background=scene.background)["rgb"], random, words.noise
        )
        wall, cpu = time.perf_counter(), time.process_time()
        found = fs.localise(
            image, scene, start, max_side=words.max_side, renderer=renderer, resident=resident
        )
        took = time.perf_counter() - wall, time.process_time() - cpu
        if number >= 0:
            rows.append(
                (
                    *pose_error(found.camera.camera_to_world, camera.camera_to_world),
                    *took,
                    normalised(found, camera),
                    found.inliers,
                    found.found,
                )
            )
    distance, angle, wall, cpu, square, inliers, agrees = np.array(rows, float).T
    near = distance < FAILED
    figures = {
        **facts(renderer),
        "trials": words.repeats,
        "median position error, mm": 1e3 * np.median(distance),
        "median angle error, degrees": math.degrees(np.median(angle)),
        "90 % of position errors below, mm": 1e3 * np.quantile(distance, 0.9),
        "within 20 mm, %": 100 * near.mean(),
        "found of those, %": 100 * agrees[near].mean(),
        "found of the others, %": 100 * agrees[~near].mean() if (~near).any() else 0.0,
        "median wall time, ms": 1e3 * np.median(wall),
        "median processor time, ms": 1e3 * np.median(cpu),
        "mean normalised squared error (6)": square[near].mean(),
        "its median (5.35)": np.median(square[near]),
        "median inliers": np.median(inliers),
    }
    if not keep(figures, words.json):
        shown = (
            (name, f"{value:.4g}" if isinstance(value, float) else str(value))
            for name, value in figures.items()
        )
        show(f"{words.distance:g} m, {words.degrees:g} degrees, noise {words.noise:g}", ("", "value"), shown)


def camera_at_random(random: np.random.Generator) -> fs.Camera:
    """A camera in an aisle of the greenhouse."""
    eye = np.array(
        [
            random.uniform(-1, 3.5),
            random.choice([0.75, 2.25]) + random.uniform(-0.2, 0.2),
            random.uniform(0.5, 1.2),
        ]
    )
    yaw = random.uniform(-0.7, 0.7) + (math.pi if eye[0] > 1.5 and random.random() < 0.5 else 0)
    pitch = random.uniform(-0.25, 0.1)
    towards = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    return fs.Camera.look_at(WIDTH, HEIGHT, FOV_X, eye, eye + towards, (0, 0, 1))


def radius(random: np.random.Generator, length: float) -> np.ndarray:
    """Random vector (3,) of a length."""
    vector = random.normal(size=3)
    return length * vector / np.linalg.norm(vector)


def photograph(image: np.ndarray, random: np.random.Generator, noise: float) -> np.ndarray:
    """The image with another gain and offset, with noise and 8 bits."""
    exposed = image * random.uniform(0.6, 0.95, 3) + random.uniform(0.02, 0.05)
    return np.rint(np.clip(exposed + random.normal(0, noise, image.shape), 0, 1) * 255).astype(np.uint8)


def changed(scene: fs.Scene, share: float) -> fs.SplatCloud:
    """The scene's splats with changed brightness."""
    splats = scene.splats
    factors = 1 + share * np.random.default_rng(0).normal(size=(len(splats), 1))
    return fs.SplatCloud(
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        colors=np.clip(splats.colors * factors, 0, 1),
        origin=splats.origin,
    )


def normalised(found: fs.Localisation, camera: fs.Camera) -> float:
    """Squared error of the pose, normalised by the covariance."""
    moved = camera.world_to_camera @ found.camera.camera_to_world
    turn = (moved[:3, :3] - moved[:3, :3].T) / 2
    error = np.array([turn[2, 1], turn[0, 2], turn[1, 0], *moved[:3, 3]])
    return float(error @ np.linalg.lstsq(found.covariance, error, rcond=None)[0])


if __name__ == "__main__":
    main()
