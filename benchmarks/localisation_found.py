"""Wrong decisions of `Localisation.found`: poses that are wrong and found, or right and not found.

    python benchmarks/localisation_found.py --repeats 8 [--seed 3000] [--width 320] [--device D]

Photographs of two greenhouses and two rooms of small splats, with noise, exposure, shadows, blur and
occluding objects; of other scenes and places; and of the scene with changed splats. Right: within 20 mm and
1 degree; wrong: more than 50 mm or 2 degrees.
"""

import math

import numpy as np
from localisation import camera_at_random, normalised, radius
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.vision.pose import pose_error
from fidsplat.vision.pyramid import smoothed
from fidsplat.worlds.greenhouse import Greenhouse

CHANGES = {
    "splats moved by 2 mm": (0.002, 0.0, 0.0),
    "splats moved by 5 mm": (0.005, 0.0, 0.0),
    "colours 10 %": (0.0, 0.1, 0.0),
    "colours 30 %": (0.0, 0.3, 0.0),
    "20 mm, colours and sizes 30 %": (0.02, 0.3, 0.3),
}
"""standard deviations of positions [m], of brightness and of the logarithm of the size"""
OBJECTS = {"flat object": (0.1, 0.3), "object": (0.1, 0.3), "large object": (0.4, 0.55)}
"""shares of the image"""
CASES = (
    *("noise 0.01", "noise 0.04", "exposure", "shadow", "defocus", *OBJECTS),
    *("far start", "other scene", "elsewhere", *CHANGES, "15 % of the splats missing"),
)


def main() -> None:
    parser = options(__doc__, repeats=8)
    parser.add_argument("--seed", type=int, default=3000)
    parser.add_argument("--width", type=int, default=320, help="pixels")
    words = parser.parse_args()
    renderer, rows = fs.Renderer(words.device), []
    for indoors in (False, True):
        for number in range(2):
            own, other = (scene_of(words.seed + number + shift, indoors) for shift in (0, 77))
            resident, background = renderer.upload(own), own.background

            def image(what, camera, background=background):
                return np.array(renderer.render(what, camera, background=background)["rgb"])

            for case in CASES:
                for trial in range(words.repeats):
                    random = np.random.default_rng([words.seed, number, indoors, CASES.index(case), trial])
                    camera = camera_of(random, indoors, words.width)
                    away, turned = (random.uniform(0.3, 0.8), 20) if case == "far start" else (0.1, 5)
                    motion = np.concatenate([radius(random, math.radians(turned)), np.zeros(3)])
                    start = offset_camera(camera, motion)
                    start = start.with_pose(position=camera.position + radius(random, away))
                    elsewhere = camera_of(random, indoors, words.width)
                    if case in CHANGES or case.startswith("15"):
                        taken = image(
                            changed(own, random, *CHANGES.get(case, (0, 0, 0)), case[0] == "1"), camera
                        )
                    else:
                        scene = other if case == "other scene" else resident
                        taken = image(scene, elsewhere if case == "elsewhere" else camera)
                    if case in OBJECTS:
                        occlude(
                            taken, None if case[0] == "f" else image(other, elsewhere), OBJECTS[case], random
                        )
                    photo = photograph(taken, case, random)
                    found = fs.localise(photo, own, start, renderer=renderer, resident=resident)
                    error = pose_error(found.camera.camera_to_world, camera.camera_to_world)
                    finite = np.isfinite(found.covariance).all()
                    square = normalised(found, camera) if finite else math.nan
                    rows.append((case, 1e3 * error[0], math.degrees(error[1]), found.found, square))
    table = [summary(case, [row for row in rows if row[0] == case]) for case in CASES]
    table.append(summary("all", rows))
    if not keep({**facts(renderer), "cases": table}, words.json):
        head = ("case", "right", "of those not found", "wrong", "of those found", "mm", "squared error / 6")
        show(f"seed {words.seed}, {words.width} pixels", head, table)


def summary(case, rows):
    """Numbers of right and wrong poses and decisions; medians of the errors."""
    _, distance, angle, found, square = (np.array(column) for column in zip(*rows, strict=True))
    right, wrong = (distance < 20) & (angle < 1), (distance > 50) | (angle > 2)
    usual = np.nanmedian(square[right]) / 6 if np.isfinite(square[right]).any() else math.nan
    numbers = (right.sum(), (right & ~found).sum(), wrong.sum(), (wrong & found).sum())
    return (case, *map(str, numbers), f"{np.median(distance):.3g}", f"{usual:.2g}")


def scene_of(seed, indoors):
    """A greenhouse, or a room with walls and objects of small splats."""
    if not indoors:
        return Greenhouse(2, 5, seed).scene
    random, half = np.random.default_rng(seed), np.array([3.0, 2.2, 1.3])
    means = random.uniform(-half, half, (9000, 3))
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (9000, 1))
    for wall, (axis, quat) in enumerate([(2, (1, 0, 0, 0)), (0, (1, 0, 1, 0)), (1, (1, 1, 0, 0))] * 2):
        own = np.arange(9000) % 6 == wall
        means[own, axis], quats[own] = (half[axis] if wall > 2 else -half[axis]), quat
    objects = random.uniform(-0.7 * half, 0.7 * half, (25, 3))[random.integers(0, 25, 1500)]
    means = np.concatenate([means, objects + random.normal(0, 0.12, objects.shape)])
    scales = np.concatenate([random.uniform(0.02, 0.08, (9000, 2)), random.uniform(0.01, 0.05, (1500, 2))])
    quats = np.concatenate([quats, random.normal(size=(1500, 4))])
    colors = random.uniform(0, 0.5, means.shape) + 0.5 * np.sin(means @ random.normal(size=(3, 3)) * 3) ** 2
    return fs.Scene([fs.SplatCloud(means, quats, scales, np.full(len(means), 0.97), colors=colors)])


def camera_of(random, indoors, width):
    """A camera at random."""
    if not indoors:
        return camera_at_random(random).resampled(width, width * 3 // 4)
    eye, yaw, pitch = (
        random.uniform((-1.2, -0.8, -0.3), (1.2, 0.8, 0.6)),
        random.uniform(-3, 3),
        random.uniform(-0.4, 0.2),
    )
    towards = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    return fs.Camera.look_at(width, width * 3 // 4, math.radians(70), eye, eye + towards, (0, 0, 1))


def changed(scene, random, moved, color, size, missing):
    """The splats of a scene with changes; missing: without 15 % of them."""
    splats = scene.splats
    kept = random.random(len(splats)) > 0.15 * missing
    count = int(kept.sum())
    factors = 1 + color * random.normal(size=(count, 1))
    return fs.SplatCloud(
        splats.means[kept] + moved * random.normal(size=(count, 3)),
        splats.quats[kept],
        splats.scales[kept] * np.exp(size * random.normal(size=(count, 1))),
        splats.opacities[kept],
        colors=np.clip(splats.colors[kept] * factors, 0, 1),
        origin=splats.origin,
    )


def occlude(image, other, shares, random):
    """Put a colour, or a part of another image, in front of a share of an image."""
    height, width = image.shape[:2]
    side = math.sqrt(random.uniform(*shares))
    down, across = int(height * side), int(width * side)
    top, left = random.integers(0, height - down), random.integers(0, width - across)
    part = np.s_[top : top + down, left : left + across]
    image[part] = random.uniform(0, 1, 3) if other is None else other[part]


def photograph(image, case, random):
    """The image with another exposure, noise and 8 bits."""
    gain, offset, noise = random.uniform(0.6, 0.95, 3), random.uniform(0.02, 0.05), 0.01
    if case == "noise 0.04":
        noise = 0.04
    if case == "exposure":
        gain, offset = random.uniform(0.25, 1.6) * random.uniform(0.8, 1.2, 3), random.uniform(-0.05, 0.1)
    if case == "shadow":
        width = image.shape[1]
        image[:, : random.integers(width // 4, 3 * width // 4)] *= random.uniform(0.3, 0.6)
    if case == "defocus":
        image = smoothed(image, 1.5 * image.shape[1] / 640)
    noisy = image * gain + offset + random.normal(0, noise, image.shape)
    return np.rint(np.clip(noisy, 0, 1) * 255).astype(np.uint8)


if __name__ == "__main__":
    main()
