"""Public calls of fidsplat with arguments that are good, for hostile_inputs.py to exchange."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import fidsplat as fs
from fidsplat.markers.kinds import parse_spec
from fidsplat.scenes import PlacedMarker
from fidsplat.vision import images
from fidsplat.vision.detect import detect
from fidsplat.vision.pose import marker_pose

Call = tuple[Callable[..., Any], dict[str, Any], Callable[[Any], Any] | None]
"""a function, arguments by name, and a use of what it gives"""

R = np.random.default_rng(0)
N = 6
MEANS, QUATS, SCALES, OPACITIES = (
    R.normal(size=(N, 3)),
    R.normal(size=(N, 4)),
    R.uniform(0.1, 1, (N, 2)),
    R.random(N),
)
CLOUD = fs.SplatCloud(MEANS, QUATS, SCALES, OPACITIES, colors=R.random((N, 3)))
CAMERA = fs.Camera.look_at(24, 16, 1.0, (0, 0, -9), (0, 0, 0))
RENDERER = fs.Renderer("reference")
PATH = fs.Trajectory([0.0, 1.0], np.stack([np.eye(4)] * 2))
TAG = fs.marker("aruco:4x4_50:7", size=0.1, mixture="exact")


def draw(scene: Any) -> None:
    """Draw what was made, be it a cloud, a scene or a marker."""
    RENDERER.render(scene, CAMERA)


def _render(**given: Any) -> Any:
    return RENDERER.render(**given)


def _frame() -> Any:
    return RENDERER.render(CLOUD, CAMERA, ["rgb", "depth"])


def _seen_by(made: Any) -> None:
    RENDERER.render(CLOUD, made)


CALLS: dict[str, Callable[[Path], Call]] = {
    "SplatCloud": lambda _: (
        fs.SplatCloud,
        {
            "means": MEANS, "quats": QUATS, "scales": SCALES, "opacities": OPACITIES, "colors": R.random((N, 3)), "sh": None,
            "labels": 0, "origin": None,
        },
        draw,
    ),
    "SplatCloud of 3D": lambda _: (
        fs.SplatCloud, {"means": MEANS, "quats": QUATS, "scales": np.ones((N, 3)), "opacities": OPACITIES, "sh": R.random((N, 4, 3))}, draw
    ),
    "SplatCloud.concatenate": lambda _: (fs.SplatCloud.concatenate, {"clouds": [CLOUD, CLOUD]}, draw),
    "SplatCloud.concatenate of": lambda _: (
        lambda a, b: fs.SplatCloud.concatenate([a, b]), {"a": CLOUD, "b": CLOUD}, draw
    ),
    "SplatCloud.with_labels": lambda _: (CLOUD.with_labels, {"labels": 3}, draw),
    "SplatCloud.with_planes": lambda _: (CLOUD.with_planes, {"planes": 3}, draw),
    "SplatCloud.with_boxes": lambda _: (CLOUD.with_boxes, {"boxes": True}, draw),
    "SplatCloud.transformed": lambda _: (CLOUD.transformed, {"matrix": np.eye(4)}, draw),
    "Camera.pinhole": lambda _: (
        fs.Camera.pinhole,
        {
            "width": 24, "height": 16, "fx": 20.0, "fy": 20.0, "cx": 12.0, "cy": 8.0, "world_to_camera": np.eye(4),
            "near": 0.1, "far": 100.0, "position": None, "lens": None,
        },
        _seen_by,
    ),
    "Camera.look_at": lambda _: (
        fs.Camera.look_at,
        {"width": 24, "height": 16, "fov_x": 1.0, "position": (0, 0, -9), "target": (0, 0, 0), "up": (0, -1, 0)},
        _seen_by,
    ),
    "Camera.fisheye": lambda _: (
        fs.Camera.fisheye, {"width": 24, "height": 16, "fov_x": 2.0}, _seen_by
    ),
    "Camera.orthographic": lambda _: (
        fs.Camera.orthographic, {"width": 24, "height": 16, "metres_wide": 3.0, "near": 0.1, "far": 50.0}, _seen_by
    ),
    "Camera.equirectangular": lambda _: (fs.Camera.equirectangular, {"width": 24, "height": 12}, _seen_by),
    "Camera.project": lambda _: (CAMERA.project, {"points": MEANS}, None),
    "Camera.rays": lambda _: (CAMERA.rays, {"pixels": np.ones((2, 2))}, None),
    "BrownConrady": lambda _: (
        fs.BrownConrady,
        {"k1": 0.1, "p1": 0.01, "k4": 0.0, "s2": 0.0},
        lambda lens: _seen_by(fs.Camera.pinhole(24, 16, 20, 20, 12, 8, lens=lens)),
    ),
    "Fisheye": lambda _: (
        fs.Fisheye, {"k1": 0.1, "k4": 0.01}, lambda lens: _seen_by(fs.Camera.pinhole(24, 16, 20, 20, 12, 8, lens=lens))
    ),
    "Trajectory": lambda _: (
        fs.Trajectory, {"times": [0.0, 1.0], "poses": np.stack([np.eye(4)] * 2), "smooth": True}, lambda path: path(0.5)
    ),
    "save_trajectory": lambda folder: (
        fs.save_trajectory,
        {"trajectory": PATH, "path": folder / "path.json", "camera": CAMERA, "images": ["a.png", "b.png"]},
        None,
    ),
    "load_trajectory": lambda folder: (
        fs.load_trajectory, {"path": folder / "none.tum", "rate": 10.0, "smooth": False}, None
    ),
    "Motion": lambda _: (
        fs.Motion,
        {"camera": None, "groups": {0: fs.Trajectory([0.0], np.eye(4)[None])}},
        lambda motion: RENDERER.render(CLOUD, CAMERA, motion=motion),
    ),
    "Scene": lambda _: (
        fs.Scene,
        {
            "clouds": [CLOUD], "camera": CAMERA, "markers": [PlacedMarker(TAG)], "background": (0, 0, 0), "outputs": ("rgb",),
            "quality": None, "device": None, "shutter": None, "camera_motion": None, "sensor": None, "fog": None,
            "cloud_motions": {},
        },
        draw,
    ),
    "Scene.load": lambda folder: (fs.Scene.load, {"path": folder / "none.toml", "quality": None}, None),
    "Scene.save": lambda folder: (fs.Scene([CLOUD]).save, {"path": folder / "saved.toml"}, None),
    "PlacedMarker": lambda _: (
        PlacedMarker, {"marker": TAG, "pose": np.eye(4), "label": 1, "motion": None}, lambda m: draw(fs.Scene(markers=[m]))
    ),
    "marker": lambda _: (
        fs.marker,
        {
            "spec": "aruco:4x4_50:7", "size": 0.1, "mixture": "fitted", "quiet_zone": 1, "growth": 0.1, "template": 9,
            "quality": None, "max_splats": 10_000,
        },
        lambda made: draw(made.cloud),
    ),
    "marker of paper": lambda _: (
        fs.marker, {"spec": "qr:a", "mixture": "paper", "levels": 2, "density": 2, "duplicates": False}, None
    ),
    "Quality": lambda _: (
        fs.Quality,
        {
            "alpha_cutoff": 1e-3, "transmittance_stop": 0.0, "stop_rule": "inclusive", "opacity_ceiling": 1.0,
            "lowpass": "screen", "order": "pixel", "samples": 1, "first_hit": 0.1, "arithmetic": "fast",
            "marker": fs.MarkerQuality(),
        },
        lambda quality: RENDERER.render(CLOUD, CAMERA, quality=quality),
    ),
    "Quality.of": lambda _: (fs.Quality.of, {"quality": "fast"}, None),
    "Quality.named": lambda _: (fs.Quality.named, {"name": "fast"}, None),
    "Quality.with_": lambda _: (fs.Quality().with_, {"samples": 2, "marker": {"levels": 2}}, None),
    "MarkerQuality": lambda _: (
        fs.MarkerQuality, {"mixture": "fitted", "levels": 2, "density": 2, "growth": None, "template": 9}, None
    ),
    "Sensor": lambda _: (
        fs.Sensor,
        {
            "exposure": 1.0, "vignetting": (0.1,), "full_well": 1e4, "read_noise": 2.0, "seed": 1, "gain": 1.0,
            "response": "srgb", "bits": 8,
        },
        lambda sensor: RENDERER.render(CLOUD, CAMERA, sensor=sensor),
    ),
    "Fog": lambda _: (
        fs.Fog, {"density": 0.1, "color": (1, 1, 1)}, lambda fog: RENDERER.render(CLOUD, CAMERA, fog=fog)
    ),
    "Gradient": lambda _: (
        fs.Gradient,
        {"top": (0, 0, 1), "bottom": (1, 1, 1), "up": (0, -1, 0)},
        lambda behind: RENDERER.render(CLOUD, CAMERA, background=behind),
    ),
    "Panorama": lambda _: (
        fs.Panorama, {"image": np.ones((4, 8, 3), np.float32)}, lambda behind: RENDERER.render(CLOUD, CAMERA, background=behind)
    ),
    "Panorama.load": lambda folder: (fs.Panorama.load, {"path": folder / "good.png"}, None),
    "load_ply": lambda folder: (fs.load_ply, {"path": folder / "good.ply"}, draw),
    "load_splats": lambda folder: (fs.load_splats, {"path": folder / "good.ply"}, draw),
    "save_splats": lambda folder: (fs.save_splats, {"cloud": CLOUD, "path": folder / "out.spz"}, None),
    "save_ply": lambda folder: (fs.save_ply, {"cloud": CLOUD, "path": folder / "out.ply", "native_2dgs": False}, None),
    "Renderer": lambda _: (fs.Renderer, {"device": "reference", "memory_budget": None}, None),
    "Renderer.upload": lambda _: (RENDERER.upload, {"scene": CLOUD}, None),
    "Renderer.render": lambda _: (
        _render,
        {
            "scene": CLOUD, "camera": CAMERA, "outputs": ("rgb",), "quality": None, "background": None, "motion": None,
            "shutter": None, "sensor": None, "fog": None,
        },
        dict,
    ),
    "Renderer.render_views": lambda _: (
        lambda **given: list(RENDERER.render_views(**given)), {"scene": CLOUD, "captures": [CAMERA], "outputs": ("rgb",)}, None
    ),
    "Renderer.render_batch": lambda _: (
        RENDERER.render_batch,
        {
            "scene": CLOUD, "captures": [CAMERA], "poses": np.array([[0, 0, 0, 1, 0, 0, 0.0]]), "groups": None,
            "mask": np.array([True]),
        },
        dict,
    ),
    "Capture": lambda _: (
        fs.Capture,
        {"camera": CAMERA, "outputs": ("rgb",), "quality": "fast", "background": (0, 0, 0), "motion": None, "shutter": None},
        lambda capture: RENDERER.render(CLOUD, capture),
    ),
    "Capture.with_": lambda _: (fs.Capture(CAMERA).with_, {"outputs": ("rgb",), "fog": fs.Fog(0.1)}, None),
    "quality_within": lambda _: (fs.quality_within, {"error": 0.01, "ms": None, "scene": None, "capture": None}, None),
    "parse_spec": lambda _: (parse_spec, {"text": "charuco:3x3:4x4_50"}, None),
    "detect": lambda _: (detect, {"image": np.zeros((16, 24, 3), np.uint8), "families": ("36h11",), "qr": True}, None),
    "to_uint8": lambda _: (images.to_uint8, {"image": np.zeros((4, 4, 3))}, None),
    "write_png": lambda folder: (images.write_png, {"path": folder / "out.png", "image": np.zeros((4, 4, 3), np.uint8)}, None),
    "marker_pose": lambda _: (
        marker_pose, {"corners": np.array([[9, 6], [15, 6], [15, 12], [9, 12.0]]), "size": 0.1, "camera": CAMERA}, None
    ),
    "Shutter": lambda _: (
        fs.Shutter, {"exposure_time": 0.01, "sub_poses": 2, "readout": 0.01, "rows_per_band": 4},
        lambda shutter: RENDERER.render(CLOUD, CAMERA, shutter=shutter),
    ),
    "Frame[]": lambda _: (lambda key: _frame()[key], {"key": "rgb"}, None),
    "Frame.get": lambda _: (lambda key: _frame().get(key), {"key": "rgb"}, None),
    "Frame.device_array": lambda _: (_frame().device_array, {"name": "rgb"}, None),
}  # fmt: skip
