"""Refine a disturbed capture of 3D Gaussians against views of the original, and find a camera pose in it.

    python benchmarks/refine_capture.py biker.compressed.ply --iterations 300 [--exact]

Centres, scales, rotations and colours are disturbed at random; views on a circle around the y axis are the
data set, and every fourth view is held out. Prints PSNR of the held-out views before and after training,
and the error of a pose before and after Adam on its six numbers.
"""

import argparse
import math
import time

import numpy as np
from real_scene import extent

import fidsplat as fs
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.images.files import to_uint8
from fidsplat.splats.harmonics import C0
from fidsplat.train import Dataset, Trainer, TrainingView

BACKGROUND = (0.72, 0.74, 0.76)
VIEWS, WIDTH, HEIGHT, FOV_X = 24, 400, 400, math.radians(40)
# relative to each scale: centres; of logarithms: scales; of quaternions; of SH of degree 0
NOISE = {"means": 0.5, "scales": 0.3, "quats": 0.1, "colors": 0.1}
TURN, SHIFT = (0.02, -0.03, 0.015), (0.06, -0.04, 0.1)  # of the pose [rad, m]
POSE_STEPS = 200
STEP_SIZES = np.repeat([4e-3, 2e-2], 3)
AT_ORIGIN = fs.Camera.pinhole(4, 4, 4, 4, 2, 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("file", help="splat file, y down")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--exact", action="store_true", help="exact 3D Gaussians instead of EWA")
    words = parser.parse_args()
    renderer, cloud = fs.Renderer(words.device), fs.load_splats(words.file)
    quality = fs.Quality.of("gsplat").with_(ellipsoid="exact" if words.exact else "ewa")
    print(f"{len(cloud):,} splats on {renderer.device.title}, {quality.ellipsoid}")
    refine(renderer, cloud, quality, words.iterations)
    find_pose(renderer, cloud, quality)


def refine(renderer: fs.Renderer, cloud: fs.SplatCloud, quality: fs.Quality, iterations: int) -> None:
    views = [
        TrainingView(
            str(k),
            camera,
            to_uint8(renderer.render(cloud, camera, quality=quality, background=BACKGROUND)["rgb"]),
        )
        for k, camera in enumerate(cameras(cloud))
    ]
    held_out = tuple(views[3::4])
    training = tuple(view for view in views if view not in held_out)
    points = cloud.world_means()[::1000]
    shades = np.full(points.shape, 128, np.uint8)
    dataset = Dataset("capture", training, held_out, points, shades, BACKGROUND)
    trainer = Trainer(
        dataset,
        renderer,
        start=disturbed(cloud),
        iterations=iterations,
        primitive="3d",
        quality=f"gsplat,ellipsoid={quality.ellipsoid}",
        sh_degree=cloud.sh_degree,
        densify_until=0,
        position_rate=1.6e-5,
    )
    before = np.mean([score.psnr for score in trainer.evaluate()])
    begun = time.perf_counter()
    trainer.run()
    seconds = (time.perf_counter() - begun) / iterations
    after = np.mean([score.psnr for score in trainer.evaluate()])
    print(
        f"held-out views: {before:.2f} dB before, {after:.2f} dB after {iterations} steps of {seconds:.3f} s"
    )


def disturbed(cloud: fs.SplatCloud) -> fs.SplatCloud:
    random, n = np.random.default_rng(0), len(cloud)
    scales = np.column_stack([cloud.scales, cloud.thickness])
    means = cloud.means + NOISE["means"] * scales.mean(axis=1, keepdims=True) * random.normal(size=(n, 3))
    sh = (cloud.colors[:, None] - 0.5) / C0 if cloud.sh is None else cloud.sh.copy()
    sh = sh + NOISE["colors"] * random.normal(size=(n, 1, 3)) * (np.arange(sh.shape[1]) == 0)[:, None]
    return fs.SplatCloud(
        means,
        cloud.quats + NOISE["quats"] * random.normal(size=(n, 4)),
        scales * np.exp(NOISE["scales"] * random.normal(size=(n, 3))),
        cloud.opacities,
        sh=sh,
        origin=cloud.origin,
    )


def cameras(cloud: fs.SplatCloud) -> list[fs.Camera]:
    low, high = extent(cloud)
    middle, away = (low + high) / 2, 0.8 * (high[1] - low[1]) / math.tan(FOV_X / 2)
    around = [
        away * np.array([math.sin(turn), -0.15 - 0.1 * math.sin(3 * turn), -math.cos(turn)])
        for turn in 2 * math.pi * np.arange(VIEWS) / VIEWS
    ]
    return [fs.Camera.look_at(WIDTH, HEIGHT, FOV_X, middle + away, middle) for away in around]


def find_pose(renderer: fs.Renderer, cloud: fs.SplatCloud, quality: fs.Quality) -> None:
    """Adam on the six numbers of a motion about the middle of the capture, so that rotation and translation
    are hardly coupled; with a step that falls to a hundredth."""
    camera, resident = cameras(cloud)[0], renderer.upload(cloud)
    target = renderer.render(resident, camera, quality=quality, background=BACKGROUND)["rgb"]
    middle = camera.world_to_camera @ [*np.mean(extent(cloud), axis=0), 1.0]
    found, first, second = offset_camera(camera, np.array([*TURN, *SHIFT])), np.zeros(6), np.zeros(6)
    errors = [pose_error(found, camera)]
    for step in range(1, POSE_STEPS + 1):
        capture = fs.Capture(found, quality=quality, background=BACKGROUND)
        frame = renderer.render_differentiable(resident, capture)
        slope = frame.backward({"rgb": (frame["rgb"] - target) / target.size})["pose"].astype(np.float64)
        slope[:3] -= np.cross(middle[:3], slope[3:])
        first, second = 0.8 * first + 0.2 * slope, 0.95 * second + 0.05 * slope**2
        size = np.sqrt(second / (1 - 0.95**step)) + 1e-12
        move = -(0.01 ** (step / POSE_STEPS)) * STEP_SIZES * first / (1 - 0.8**step) / size
        move[3:] += middle[:3] - offset_camera(AT_ORIGIN, move).world_to_camera[:3, :3] @ middle[:3]
        found = offset_camera(found, move)
    errors.append(pose_error(found, camera))
    for name, (degrees, millimetres) in zip(("start", "found"), errors, strict=True):
        print(f"pose, {name}: {degrees:.3f} degrees, {millimetres:.1f} mm off")


def pose_error(found: fs.Camera, camera: fs.Camera) -> tuple[float, float]:
    """Angle [degrees] and distance [mm]."""
    turned = found.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    angle = math.degrees(math.acos(min(1.0, (np.trace(turned) - 1) / 2)))
    return angle, 1e3 * float(np.linalg.norm(found.position - camera.position))


if __name__ == "__main__":
    main()
