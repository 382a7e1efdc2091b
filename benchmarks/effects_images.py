"""Make the images of effects for the pages and the README, except the low-pass (filter_quality.py).

python benchmarks/effects_images.py [--device opencl] [--out docs/images]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

import fidsplat as fs
from fidsplat.images.files import to_uint8
from fidsplat.images.visualize import (
    color_counts,
    color_depth,
    color_labels,
    color_normals,
    contact_sheet,
    count_key,
    depth_key,
    depth_span,
    normal_key,
)
from fidsplat.markers import BentSheet, BoxEdge, Cone, Crumpled, Cylinder, Wear
from fidsplat.scenes import PlacedMarker

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples"))
from make_data import globe, sky  # noqa: E402

WIDTH, HEIGHT = 480, 300
DUSK = (0.0, 0.15, 0.6), (1.0, 0.7, 0.3)  # above, below


def path_with_tags(mixture: str) -> fs.Scene:
    """Scene of three tags on a path of grey splats."""
    generator = np.random.default_rng(2)
    n = 4000
    means = np.column_stack([generator.uniform(-4, 4, n), np.full(n, 0.6), generator.uniform(0.5, 14, n)])
    means[:, 1] += generator.normal(0, 0.02, n)
    lying = [math.cos(math.pi / 4), math.sin(math.pi / 4), 0, 0]
    shade = generator.uniform(0.2, 0.5, (n, 1)) * [1.0, 0.9, 0.7]
    ground = fs.SplatCloud(
        means, np.tile(lying, (n, 1)), np.full((n, 2), 0.12), np.full(n, 0.9), colors=shade
    )
    tags = []
    for number, (x, z, turn) in enumerate(((-0.6, 2.2, 25), (0.7, 4.0, -35), (-0.2, 8.0, 10))):
        a = math.radians(turn)
        pose = np.eye(4)
        pose[0, [0, 2]], pose[2, [0, 2]] = (math.cos(a), math.sin(a)), (-math.sin(a), math.cos(a))
        pose[:3, 3] = (x, 0, z)
        tags.append(PlacedMarker(fs.marker(f"apriltag:36h11:{number}", size=0.9, mixture=mixture), pose))
    camera = fs.Camera.look_at(WIDTH, HEIGHT, math.radians(62), (0.1, -0.5, -0.4), (0, 0.1, 5))
    return fs.Scene([ground], camera, tags, background=(0.55, 0.7, 0.9))


def save(file: Path, image: np.ndarray) -> None:
    """Write a JPEG without chroma subsampling, so that edges of markers stay sharp."""
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        88,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    cv2.imwrite(str(file), image[:, :, ::-1], options)


def examples(renderer: fs.Renderer, out: Path) -> None:
    """Render the scene files that the pages show with an image, WIDTH pixels wide."""
    folder = ROOT / "examples"
    files = sorted(
        file for name in ("lens-*", "shutter-*", "together") for file in folder.glob(f"{name}.toml")
    )
    for file in track(files, "examples", console=Console(stderr=True)):
        scene = fs.Scene.load(file)
        small = scene.camera
        assert small is not None
        times = WIDTH / small.width
        camera = replace(
            small,
            width=WIDTH,
            height=round(small.height * times),
            **{name: getattr(small, name) * times for name in ("fx", "fy", "cx", "cy")},
        )
        save(out / f"effect-{file.stem}.jpg", to_uint8(renderer.render(scene, camera)["rgb"]))


def turned(degrees: float) -> Callable[[float], np.ndarray]:
    """Motion of the scene's camera, a rotation by some degrees per second."""

    def pose(time: float) -> np.ndarray:
        angle = math.radians(degrees) * time
        target = (0.1 + 5.4 * math.sin(angle), 0.1, -0.4 + 5.4 * math.cos(angle))
        return fs.Camera.look_at(8, 8, 1, (0.1, -0.5, -0.4), target).world_to_camera

    return pose


def shining(degree: int) -> fs.Scene:
    """Scene of the globe with spherical harmonics up to a degree."""
    camera = fs.Camera.look_at(WIDTH, HEIGHT, math.radians(50), (0.9, -0.9, -1.6), (0, 0, 0))
    return fs.Scene([globe(degree)], camera, background=(0.5, 0.5, 0.5))


def all_effects(renderer: fs.Renderer) -> list[tuple[str, np.ndarray]]:
    """Titled images of twelve effects, all of one shape."""
    marked = path_with_tags("exact")
    camera = marked.camera
    assert camera is not None

    def through(lens=None, **focal) -> fs.Camera:
        return replace(camera, lens=lens, **focal)

    def rendered(scene: fs.Scene = marked, **call) -> np.ndarray:
        return to_uint8(renderer.render(scene, **call)["rgb"])

    def example(name: str) -> fs.Scene:
        return fs.Scene.load(ROOT / "examples" / f"{name}.toml")

    fisheye = fs.Camera.fisheye(WIDTH, HEIGHT, math.radians(200))
    wide = fs.Camera.orthographic(WIDTH, HEIGHT, 4.0, world_to_camera=camera.world_to_camera)
    turn = fs.Motion(turned(150))
    panels = {
        "pinhole": rendered,
        "distortion (Brown-Conrady)": lambda: rendered(camera=through(fs.BrownConrady(-0.4, 0.12))),
        "fisheye, 200 degrees": lambda: rendered(example("lens-fisheye"), camera=fisheye),
        "panorama": lambda: rendered(
            example("lens-panorama"), camera=fs.Camera.equirectangular(WIDTH, HEIGHT)
        ),
        "parallel rays": lambda: rendered(camera=wide),
        "motion blur": lambda: rendered(motion=turn, shutter=fs.Shutter(exposure_time=0.03, sub_poses=16)),
        "rolling shutter": lambda: rendered(motion=turn, shutter=fs.Shutter(readout=0.1, rows_per_band=1)),
        "fog": lambda: rendered(fog=fs.Fog(0.15, (0.75, 0.78, 0.8))),
        "background: gradient": lambda: rendered(background=fs.Gradient(*DUSK)),
        "background: panorama": lambda: rendered(background=fs.Panorama(sky())),
        "vignetting": lambda: rendered(sensor=fs.Sensor(vignetting=(-0.6,))),
        "noise": lambda: rendered(sensor=fs.Sensor(full_well=200, read_noise=6)),
    }
    return [(name, draw()) for name, draw in track(panels.items(), "effects", console=Console(stderr=True))]


def outputs_sheet(renderer: fs.Renderer, scene: fs.Scene) -> np.ndarray:
    """Sheet of six outputs of one frame in rows of two, with the colour key of the right one."""
    frame = renderer.render(scene, outputs=("rgb", "normal", "depth", "distance", "label", "blended"))
    depth, distance = frame["depth"], frame["distance"]
    span = depth_span([depth, distance])
    rows = [
        [("rgb", to_uint8(frame["rgb"])), ("normal", color_normals(frame["normal"]))],
        [("depth", color_depth(depth, span)), ("distance", color_depth(distance, span))],
        [("label", color_labels(frame["label"])), ("blended (splats)", color_counts(frame["blended"]))],
    ]
    most = int(frame["blended"].max())
    keys = (normal_key, partial(depth_key, span), partial(count_key, most))
    return contact_sheet(rows, width=WIDTH, key=lambda row, height: keys[row](height))


def light_sheet(renderer: fs.Renderer) -> np.ndarray:
    """Sheet of the examples of light on markers, with their first marker enlarged four times."""
    rows = []
    for name in ("lit-tag", "shadow-tag", "glossy-tag"):
        scene = renderer.lit(fs.Scene.load(ROOT / "examples" / f"{name}.toml"))
        small = scene.camera
        assert small is not None
        times = WIDTH / small.width
        fx, cx, cy = small.fx * times, WIDTH / 2, HEIGHT / 2
        camera = replace(small, width=WIDTH, height=HEIGHT, fx=fx, fy=fx, cx=cx, cy=cy)
        x, y = camera.project(scene.markers[0].pose[None, :3, 3])[0]
        near = replace(camera, fx=4 * fx, fy=4 * fx, cx=4 * (cx - x) + cx, cy=4 * (cy - y) + cy)
        views = ((name, camera), ("4 times larger", near))
        rows.append([(title, to_uint8(renderer.render(scene, view)["rgb"])) for title, view in views])
    return contact_sheet(rows, width=WIDTH)


def drawing_sheet(renderer: fs.Renderer) -> np.ndarray:
    """Sheet of a tilted SVG drawing, and of its corner from a twelfth of the distance."""
    sign = fs.Scene(markers=[PlacedMarker(fs.marker(f"svg:{ROOT / 'examples/data/sign.svg'}"))])
    eye, panels = np.array((0.3, -0.2, -1.1)), []
    for name, target, away in (
        ("sign.svg", (0, 0, 0), 1.0),
        ("twelve times as near", (0.14, 0.07, 0), 1 / 12),
    ):
        camera = fs.Camera.look_at(WIDTH, HEIGHT, math.radians(55), target + away * eye, target)
        frame = renderer.render(sign, camera, background=(0.55, 0.7, 0.9))
        panels.append((name, to_uint8(frame["rgb"])))
    return contact_sheet([panels], width=WIDTH)


def turned_marker(renderer: fs.Renderer, size: tuple[int, int], **settings) -> np.ndarray:
    """Image of a tilted AprilTag with a shape or wear."""
    camera = fs.Camera.look_at(*size, math.radians(46), (0.12, -0.13, -0.27), (0, 0, 0.01))
    scene = fs.Scene(markers=[PlacedMarker(fs.marker("apriltag:36h11:5", 0.16, **settings))])
    return to_uint8(renderer.render(scene, camera, background=(0.45, 0.5, 0.55))["rgb"])


def shapes_sheet(renderer: fs.Renderer) -> np.ndarray:
    """Sheet of a tag on each shape, with details of two enlarged four times."""
    shapes = {
        "cylinder, radius 0.06": Cylinder(0.06),
        "cone, radius 0.09, taper 0.4": Cone(0.09, 0.4),
        "bent, radius 0.05, length 0.15": BentSheet(0.05, 0.15),
        "edge, radius 0.006": BoxEdge(0.006),
        "crumpled, height 0.009, length 0.09": Crumpled(0.009, 0.09, 2),
    }
    panels = [(name, turned_marker(renderer, (WIDTH, HEIGHT), shape=shape)) for name, shape in shapes.items()]
    return contact_sheet([panels[:3], [*panels[3:], ("crumpled, 4 x", enlarged(panels[4][1]))]], width=WIDTH)


def wear_sheet(renderer: fs.Renderer) -> np.ndarray:
    """Sheet of a tag with each kind of wear."""
    severities = {"bleed": 0.3, "coarseness": 0.4, "fading": 0.6, "dirt": 0.3, "drops": 0.3}
    severities |= {"scratches": 0.2, "tear": 0.2, "fold": 0.4, "cover": 0.2}
    panels = [
        (
            f"{name} {severity:g}",
            turned_marker(renderer, (WIDTH, HEIGHT), wear=Wear(**{name: severity}, seed=2)),
        )
        for name, severity in severities.items()
    ]
    return contact_sheet([panels[k : k + 3] for k in (0, 3, 6)], width=WIDTH)


def enlarged(image: np.ndarray) -> np.ndarray:
    """The middle of an image, a quarter of each side, enlarged four times."""
    h, w = image.shape[0] // 4, image.shape[1] // 4
    top, left = (image.shape[0] - h) // 2, (image.shape[1] - w) // 2
    return image[top : top + h, left : left + w].repeat(4, 0).repeat(4, 1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images")
    options = parser.parse_args()
    renderer = fs.Renderer(options.device)
    scene, exact = path_with_tags("fitted"), path_with_tags("exact")

    def image(what: fs.Scene, **call) -> np.ndarray:
        return to_uint8(renderer.render(what, **call)["rgb"])

    near = fs.Camera.look_at(WIDTH, HEIGHT, math.radians(14), (0.1, -0.5, -0.4), (-0.55, 0.0, 2.2))
    far = replace(
        near, world_to_camera=fs.Camera.look_at(8, 8, 1, (0.1, -0.5, -0.4), (-0.2, 0, 8)).world_to_camera
    )
    boxes = [
        [("fitted, near", image(scene, camera=near)), ("exact, near", image(exact, camera=near))],
        [("fitted, far", image(scene, camera=far)), ("exact, far", image(exact, camera=far))],
    ]
    save(options.out / "effect-boxes.jpg", contact_sheet(boxes, width=WIDTH))
    save(options.out / "drawing.jpg", drawing_sheet(renderer))
    save(options.out / "effect-light.jpg", light_sheet(renderer))
    save(options.out / "effect-shapes.jpg", shapes_sheet(renderer))
    save(options.out / "effect-wear.jpg", wear_sheet(renderer))
    save(options.out / "effect-outputs.jpg", outputs_sheet(renderer, exact))

    panels = [
        ("plain", image(exact)),
        ("fog, 0.15 / m", image(exact, fog=fs.Fog(0.15, (0.75, 0.78, 0.8)))),
        ("gradient", image(exact, background=fs.Gradient(*DUSK))),
        ("panorama", image(exact, background=fs.Panorama(sky()))),
        ("vignetting, -0.6", image(exact, sensor=fs.Sensor(vignetting=(-0.6,)))),
        ("noise, 200 electrons", image(exact, sensor=fs.Sensor(full_well=200, read_noise=6))),
    ]
    save(options.out / "effect-sensor.jpg", contact_sheet([panels[:2], panels[2:4], panels[4:]], width=WIDTH))

    globes = [("plain" if degree == 0 else f"degree {degree}", shining(degree)) for degree in range(4)]
    colors = [(name, image(what)) for name, what in globes]
    save(options.out / "effect-color.jpg", contact_sheet([colors[:2], colors[2:]], width=WIDTH))

    examples(renderer, options.out)
    panels = all_effects(renderer)
    save(
        options.out / "effects.jpg",
        contact_sheet([panels[k : k + 3] for k in range(0, len(panels), 3)], width=WIDTH),
    )


if __name__ == "__main__":
    main()
