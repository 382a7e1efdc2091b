"""Compare lit and bent markers with Blender's Cycles: radiance, shadow edges, corners, detection rates.

python benchmarks/light_truth.py -o light-truth                 `fidsplat experiment blender --install` before
python benchmarks/light_truth.py -o light-truth --poses 1000 --samples 128 --case poses

A marker is on the wall of a room of glowing panels, under a shelf; fidsplat renders the panels as boxes,
Blender as planes. Existing images of Blender are reused, so that an interrupted run resumes.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress, count, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import fidsplat as fs
from fidsplat.experiments.blender import default_environment, image_job, ready, run_worker
from fidsplat.experiments.tags_report import NORMAL, wilson
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.filters import grey_of
from fidsplat.images.visualize import contact_sheet
from fidsplat.markers import Crumpled, Cylinder
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.util.files import atomic_write, writable_folder
from fidsplat.util.provenance import run_facts
from fidsplat.util.response import linear_light, to_colors
from fidsplat.vision.readers import Target, attempt, readers

SIZE = 0.2
WORKER = Path(__file__).with_name("blender_room.py")
SHELF = 0.16
"""metres of the shelf above the middle of the marker, and half of its depth"""
SQUARE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
CELL = 0.1
"""metres: edges of the boxes that panels are made of"""


@dataclass(frozen=True)
class Case:
    """A marker, its light and views."""

    name: str
    shape: Any = None
    roughness: float | None = None
    lights: tuple[fs.Sun | fs.PointLight, ...] = ()
    emits: bool = False
    """whether the marker shines by itself, for geometry; both renderers then average display values"""
    cameras: tuple[fs.Camera, ...] = field(default=(), repr=False)

    @property
    def response(self) -> str:
        """Response that converts Blender's values to display values."""
        return "linear" if self.emits else "srgb"

    @property
    def colors(self) -> str:
        """Response of the splats' colours. For poses they are linear light, so that pixels average light as
        Blender's do."""
        return "linear" if self.name == "poses" else "srgb"

    @property
    def marker(self) -> fs.Marker:
        return fs.marker("apriltag:36h11:5", SIZE, shape=self.shape)


def panels() -> list[tuple[np.ndarray, np.ndarray, tuple[float, float, float], np.ndarray]]:
    """Middle, half edges (2, 3) and radiance of each panel of the room, and its normal. The marker's frame: x
    right, y down, z into the wall.

    Panels extend beyond the edges of the room: coverage of pixels is composited, so that panels that only
    meet would be translucent there.
    """
    x, y, z = np.eye(3)
    room = [
        (1.0 * x - z, y * 1.1, z * 1.3, (0.10, 0.25, 0.60)),
        (-1.0 * x - z, y * 1.1, z * 1.3, (0.50, 0.22, 0.12)),
        (-0.8 * y - 0.1 * z, x * 1.3, z * 0.4, (0.80, 0.78, 0.70)),  # open in front, for the sun
        (0.8 * y - z, x * 1.3, z * 1.3, (0.10, 0.08, 0.06)),
        (-2.0 * z, x * 1.3, y * 1.1, (0.30, 0.32, 0.35)),
        (0.02 * z, x * 1.3, y * 1.1, (0.20, 0.20, 0.20)),
        (-SHELF * y - (SHELF / 2 - 0.05) * z, 0.3 * x, (SHELF / 2 + 0.05) * z, (0.03, 0.03, 0.03)),
    ]
    return [(m, np.stack([u, v]), radiance, np.cross(u, v)) for m, u, v, radiance in room]


def cloud(response: str = "srgb") -> fs.SplatCloud:
    """Box splats of the panels."""
    parts = []
    for number, (middle, halves, radiance, _) in enumerate(panels()):
        lengths = np.linalg.norm(halves, axis=1)
        counts = np.maximum(1, np.ceil(2 * lengths / CELL)).astype(int)
        axes = halves / lengths[:, None]
        turn = matrix_to_quaternion(np.stack([*axes, np.cross(*axes)], 1))
        shares = [(np.arange(n) + 0.5) / n * 2 - 1 for n in counts]
        at = np.stack(np.meshgrid(*shares, indexing="ij"), -1).reshape(-1, 2)
        n = len(at)
        boxes = fs.SplatCloud(
            middle + at @ halves, [turn] * n, [lengths / counts] * n, np.ones(n),
            colors=np.tile(to_colors(np.array(radiance), response), (n, 1)),
        ).with_boxes()  # fmt: skip
        parts.append(boxes.with_coplanar_groups(np.full(n, number)))
    return fs.SplatCloud.concatenate(parts)


def camera_at(rng: np.random.Generator, width: int, height: int, edges: tuple[float, float]) -> fs.Camera:
    """A camera in the room, below the shelf, whose image shows the marker."""
    tilt, around = math.radians(rng.uniform(5, 55)), rng.uniform(-0.15 * math.pi, 1.15 * math.pi)
    away = np.array([math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), -math.cos(tilt)])
    position = SIZE * rng.uniform(*edges) * away
    target = (*rng.uniform(-0.1, 0.1, 2) * SIZE, 0.0)
    roll = rng.uniform(-0.4, 0.4)
    return fs.Camera.look_at(width, height, math.radians(45), position, target, (math.sin(roll), -1.0, 0.0))


def inside(camera: fs.Camera) -> bool:
    """Whether a camera is in the room."""
    x, y, z = camera.position
    return abs(x) < 1 and abs(y) < 0.8 and -2 < z < 0


def resized(camera: fs.Camera, factor: float) -> fs.Camera:
    """The camera with an image scaled by a factor."""
    size = (round(camera.width * factor), round(camera.height * factor))
    numbers = (factor * value for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return fs.Camera.pinhole(*size, *numbers, camera.world_to_camera)


def reduced(light: np.ndarray, factor: int) -> np.ndarray:
    """The image reduced by a factor, with means of linear light."""
    size = (light.shape[1] // factor, light.shape[0] // factor)
    return cv2.resize(light.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def cases(poses: int) -> list[Case]:
    """All cases; the last case has the views for detection rates."""
    rng = np.random.default_rng(0)
    three = tuple(camera_at(rng, 320, 240, (3.0, 4.0)) for _ in range(3))
    sun = fs.Sun(direction=(0.25, 0.8, 0.75), intensity=4.0, angle=math.radians(2), samples=64)
    lamp = fs.PointLight(position=(0.4, 0.1, -0.5), intensity=0.25, radius=0.05, samples=64)
    small = tuple(islice(filter(inside, (camera_at(rng, 160, 120, (3.0, 12.0)) for _ in count())), poses))
    return [
        Case("room", cameras=three),
        Case("room and sun", lights=(sun,), cameras=three),
        Case("room and lamp", lights=(lamp,), cameras=three),
        Case("glossy, 0.5", roughness=0.5, lights=(lamp,), cameras=three),
        Case("glossy, 0.3", roughness=0.3, lights=(lamp,), cameras=three),
        Case("cylinder in the room", Cylinder(radius=SIZE), cameras=three),
        Case("cylinder, shining", Cylinder(radius=SIZE), emits=True, cameras=three),
        Case(
            "crumpled, shining", Crumpled(height=0.08 * SIZE, length=SIZE, seed=1), emits=True, cameras=three
        ),
        Case("poses", lights=(lamp,), cameras=small),
    ]


def scene_of(case: Case, camera: fs.Camera) -> fs.Scene:
    """Scene of a case for fidsplat."""
    light = fs.Lighting(
        roughness=case.roughness,
        view="any" if case.roughness is None else "camera",
        response=case.colors,
    )
    if case.emits:
        greys = (tuple(to_colors(np.full(3, value), "srgb").tolist()) for value in (light.ink, light.paper))
        black, white = greys
        made = fs.marker(case.marker.spec, SIZE, shape=case.shape, black=black, white=white)
        return fs.Scene((cloud(),), markers=(PlacedMarker(made),))
    placed = PlacedMarker(case.marker, light=light)
    return fs.Scene((cloud(case.colors),), camera, markers=(placed,), lights=case.lights)


def ours(case: Case, renderer: fs.Renderer) -> Iterator[np.ndarray]:
    """Images (h, w, 3) of fidsplat in display values, or in linear light for poses."""
    scene, quality = None, fs.Quality(samples=1 if case.name == "poses" else 2)
    for camera in case.cameras:
        if scene is None or case.roughness is not None:  # gloss depends on the camera
            scene = scene_of(case, camera)
        yield renderer.render(scene, camera, quality=quality)["rgb"]


def job_of(case: Case, folder: Path) -> dict:
    """Job of a case for the Blender worker."""
    made, steps = case.marker, 1 if case.shape is None else 96
    half = np.array(made.grid.shape[::-1]) * made.module / 2
    shares = np.linspace(-1, 1, steps + 1)
    at = np.stack(np.meshgrid(shares * half[0], shares * half[1]), -1).reshape(-1, 2)
    light = fs.Lighting()
    shown = partial(to_colors, response="srgb" if case.emits else "linear")
    return {
        "name": case.name,
        "panels": [
            {"corners": (m + SQUARE @ h).tolist(), "radiance": shown(np.array(radiance)).tolist()}
            for m, h, radiance, _ in panels()
        ],
        "lights": [
            {"kind": one.kind, "intensity": one.intensity}
            | (
                {"direction": one.direction, "angle": one.angle}
                if isinstance(one, fs.Sun)
                else {"position": one.position, "radius": one.radius}
            )
            for one in case.lights
        ],
        "points": made.points(at).reshape(steps + 1, steps + 1, 3).tolist(),
        "grid": made.grid.tolist(),
        "ink": float(shown(np.array(light.ink))),
        "paper": float(shown(np.array(light.paper))),
        "roughness": case.roughness,
        "emits": case.emits,
        "smooth": case.shape is not None,
        "images": [
            image_job(folder / f"{case.name.replace(' ', '-').replace(',', '')}-{k:04d}.npy", camera)
            for k, camera in enumerate(case.cameras)
        ],
    }


def modules_of(case: Case, camera: fs.Camera) -> np.ndarray:
    """Module of a flat marker in which a pixel is with its surroundings of 1.5 pixels; -1 elsewhere."""
    made = case.marker
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    found = None
    for dx, dy in ((0, 0), (-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (-1.5, 1.5)):
        pixels = np.stack([x + 0.5 + dx, y + 0.5 + dy], -1).reshape(-1, 2)
        rays = camera.rays(pixels) @ camera.world_to_camera[:3, :3]
        at = camera.position + rays * (-camera.position[2] / rays[:, 2])[:, None]
        cell = np.floor(at[:, :2] / made.module + np.array(made.grid.shape[::-1]) / 2).astype(int)
        inside = ((cell >= 0) & (cell < made.grid.shape[::-1])).all(1) & (rays[:, 2] > 0)
        index = np.where(inside, cell[:, 1] * made.grid.shape[1] + cell[:, 0], -1)
        found = index if found is None else np.where(found == index, found, -1)
    assert found is not None
    return found.reshape(camera.height, camera.width)


def radiance_errors(case: Case, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, list[float]]:
    """Relative errors of the mean linear radiance of modules, by colour."""
    errors: dict[str, list[float]] = {"paper": [], "ink": []}
    grid = case.marker.grid.ravel()
    for camera, (own, truth) in zip(case.cameras, pairs, strict=True):
        modules = modules_of(case, camera)
        for module in np.unique(modules[modules >= 0]).tolist():
            inside = modules == module
            if inside.sum() < 6:
                continue
            expected = truth[inside].mean(0)
            error = np.abs(own[inside].mean(0) - expected).max() / expected.mean()
            errors["ink" if grid[module] else "paper"].append(float(error))
    return errors


def smooth_errors(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Relative errors of radiance in smooth areas of an image, for means over 5 x 5 pixels."""
    found = []
    for own, truth in pairs:
        mean, other = cv2.blur(truth.mean(-1), (5, 5)), cv2.blur(own.mean(-1).astype(np.float32), (5, 5))
        kernel = np.ones((9, 9), np.uint8)
        smooth = cv2.dilate(mean, kernel) < 1.15 * cv2.erode(mean, kernel)
        # the panels are exact in both
        differs = smooth & (np.abs(truth - np.float32(0.2)).max(-1) > 0.02) & (mean > 0.035)
        found.append(np.abs(other / mean - 1)[differs])
    every = np.concatenate(found)
    return {
        "pixels": len(every),
        "median_percent": 100 * float(np.median(every)),
        "p95_percent": 100 * float(np.percentile(every, 95)),
    }


def half_light(case: Case, camera: fs.Camera, image: np.ndarray) -> np.ndarray:
    """Rows at which the sun's share of the light crosses one half in each column of the image, NaN where it
    does not."""
    modules = modules_of(case, camera)
    albedo = np.where(case.marker.grid.ravel()[np.maximum(modules, 0)], 0.05, 0.85)
    light = np.where(modules >= 0, image.mean(-1) / albedo, np.nan)
    most = np.nanpercentile(light, 95)
    rows = np.full(image.shape[1], np.nan)
    for column in range(image.shape[1]):
        known = np.flatnonzero(np.isfinite(light[:, column]))
        if len(known) < 20:
            continue
        values = light[known, column] - most / 2
        for k in np.flatnonzero(np.sign(values[:-1]) < np.sign(values[1:])):
            share = -values[k] / (values[k + 1] - values[k])
            if known[k + 1] - known[k] <= 6:
                rows[column] = known[k] + share * (known[k + 1] - known[k]) + 0.5
    return rows


def read_all(case: Case, images: Iterator[np.ndarray]) -> dict[str, list[float | None]]:
    """Corner errors in pixels of each image by detector; None if the marker is not read."""
    made = case.marker
    names = readers(made.kind, made.family)
    found: dict[str, list[float | None]] = {name: [] for name in names}
    placed = PlacedMarker(made)
    for camera, image in zip(case.cameras, images, strict=True):
        corners = camera.project(placed.corners)
        target = Target(made.kind, made.family or "", made.id, None, corners)
        for name in names:
            read = attempt(name, grey_of(to_uint8(image)), target).corners
            found[name].append(
                None if read is None else float(np.sqrt(((read - corners) ** 2).sum(1).mean()))
            )
    return found


def corner_distances(case: Case, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Distances in pixels between the corners of modules in our images and in Blender's, by OpenCV's
    `cornerSubPix` in both."""
    made, found = case.marker, []
    grid = made.grid.astype(int)
    block = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]])
    row, column = np.nonzero(block.sum(0) % 2 + (block[0] == block[3]) * (block[0] != block[1]))
    at = (np.stack([column + 1, row + 1], 1) - np.array(grid.shape[::-1]) / 2) * made.module
    rule = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    for camera, images in zip(case.cameras, pairs, strict=True):
        pixels = (camera.project(made.points(at)) - 0.5).astype(np.float32)
        inside = ((pixels > 8) & (pixels < np.array([camera.width, camera.height]) - 8)).all(1)
        one, other = (
            cv2.cornerSubPix(grey_of(to_uint8(image)), pixels[inside].copy(), (3, 3), (-1, -1), rule)
            for image in images
        )
        near = np.linalg.norm(one - pixels[inside], axis=1) < 2  # both found this corner
        found.append(np.linalg.norm(one - other, axis=1)[near])
    return np.concatenate(found)


def main() -> int:
    """Render, compare, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--out", default="light-truth", help="folder for images and figures")
    parser.add_argument("--samples", type=int, default=256, help="of Cycles")
    parser.add_argument("--poses", type=int, default=200, help="views for detection rates")
    parser.add_argument("--existing", action="store_true", help="compare only existing images of Blender")
    parser.add_argument("--case", action="append", default=None, help="name of a case (default: all)")
    parser.add_argument("--device", default=None)
    parser.add_argument("--threads", type=int, default=None)
    arguments = parser.parse_args()
    folder = writable_folder(arguments.out)
    python = ready("raw", default_environment())
    renderer = fs.Renderer(arguments.device)
    figures: dict[str, Any] = {"run": run_facts(renderer.device.title, 0), "samples": arguments.samples}
    for case in cases(arguments.poses):
        if arguments.case and case.name not in arguments.case:
            continue
        job = {"samples": arguments.samples, "denoise": False}
        one = job_of(case, folder)
        if arguments.existing:
            found = [Path(image["file"]).is_file() for image in one["images"]]
            one["images"] = list(compress(one["images"], found))
            case = replace(case, cameras=tuple(compress(case.cameras, found)))
        list(run_worker(python, WORKER, [one], job, arguments.threads))
        truth = [np.load(image["file"]) for image in one["images"]]
        own = list(ours(case, renderer))
        figures[case.name] = compare(case, own, truth)
        print(case.name, json.dumps(figures[case.name]), flush=True)
        shown = [
            (f"{case.name}, {name}", to_uint8(image))
            for name, image in (
                ("ours", to_colors(linear_light(own[0], case.colors), "srgb")),
                ("Cycles", to_colors(truth[0], "linear" if case.emits else "srgb")),
            )
        ]
        write_png(folder / f"{case.name.replace(' ', '-').replace(',', '')}.png", contact_sheet([shown]))
    with atomic_write(folder / "light-truth.json") as stream:
        stream.write(json.dumps(figures, indent=1).encode())
    return 0


def detection(case: Case, light: dict[str, list[np.ndarray]], factor: int) -> dict[str, Any]:
    """Detections in images reduced by a factor: numbers, intervals of their shares, equal results, median
    errors of corners, and the difference of the shares in percentage points with its interval of 95 %."""
    small = replace(case, cameras=tuple(resized(camera, 1 / factor) for camera in case.cameras))
    errors = {
        name: read_all(
            small, (np.asarray(to_colors(reduced(image, factor), "srgb"), np.float32) for image in images)
        )
        for name, images in light.items()
    }
    found: dict[str, Any] = {}
    for detector in errors["ours"]:
        each = {name: np.array(own[detector], float) for name, own in errors.items()}
        read = {name: np.isfinite(own) for name, own in each.items()}
        found[detector] = {
            name: [int(own.sum()), *wilson(int(own.sum()), len(own)), float(np.nanmedian(each[name]))]
            for name, own in read.items()
        } | {"equal": float((read["ours"] == read["Cycles"]).mean())}
        apart = 100.0 * (read["ours"].astype(int) - read["Cycles"])  # of the same pose
        half = NORMAL * float(apart.std()) / math.sqrt(len(apart))
        found[detector]["difference"] = [float(apart.mean()) + off for off in (0.0, -half, half)]
    return found


def compare(case: Case, own: list[np.ndarray], truth: list[np.ndarray]) -> dict[str, Any]:
    """Measured figures of a case. own: images of `ours`. truth: Blender's images in linear light."""
    shown = [np.asarray(to_colors(image, case.response), np.float32) for image in truth]
    if case.name == "poses":
        light = {"ours": own, "Cycles": truth}
        return {"views": len(own)} | {f"1/{k}": detection(case, light, k) for k in (1, 2, 3)}
    if case.shape is not None and not case.emits:
        return smooth_errors([(linear_light(a, "srgb"), b) for a, b in zip(own, truth, strict=True)])
    if case.shape is not None:
        apart = corner_distances(case, list(zip(own, shown, strict=True)))
        differ = [float(np.abs(a - b).mean()) for a, b in zip(own, shown, strict=True)]
        return {
            "corners": len(apart),
            "median_px": float(np.median(apart)),
            "p95_px": float(np.percentile(apart, 95)),
            "mean_difference": float(np.mean(differ)),
        }
    pairs = [(linear_light(a, "srgb"), b) for a, b in zip(own, truth, strict=True)]
    errors = radiance_errors(case, pairs)
    facts: dict[str, Any] = {
        name: {
            "modules": len(each),
            "median_percent": 100 * float(np.median(each)),
            "p95_percent": 100 * float(np.percentile(each, 95)),
        }
        for name, each in errors.items()
    }
    if case.name == "room and sun":
        rows = [
            half_light(case, camera, a) - half_light(case, camera, b)
            for camera, (a, b) in zip(case.cameras, pairs, strict=True)
        ]
        every = np.concatenate(rows)
        every = every[np.isfinite(every)]
        facts["shadow_edge_px"] = {
            "columns": len(every),
            "rms": float(np.sqrt((every**2).mean())) if len(every) else None,
        }
    return facts


if __name__ == "__main__":
    raise SystemExit(main())
