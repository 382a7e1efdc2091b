"""Public calls of fidsplat with good arguments, which tests exchange for bad ones."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import fidsplat as fs
from fidsplat.images import files as image_files
from fidsplat.markers.kinds import parse_spec
from fidsplat.scenes import PlacedMarker
from fidsplat.sim import Rig, RigCamera, read_description
from fidsplat.train import Dataset, Trainer, TrainingView, TrainSettings, load_dataset, refine, splats_within
from fidsplat.vision.coco import CocoAnnotations
from fidsplat.vision.detect import detect
from fidsplat.vision.pose import marker_pose
from fidsplat.vision.readback import read_back
from fidsplat.vision.truth import optical_flow, points_of, truth_of

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
    """Render a cloud, a scene or a marker."""
    RENDERER.render(scene, CAMERA)


def _render(**given: Any) -> Any:
    return RENDERER.render(**given)


def _frame() -> Any:
    return RENDERER.render(CLOUD, CAMERA, ["rgb", "depth"])


def _render_camera(made: Any) -> None:
    RENDERER.render(CLOUD, made)


def _rows(made: Any) -> None:
    list(made)


VIEWS = tuple(
    TrainingView(
        f"{x}", fs.Camera.look_at(12, 8, 1.0, (x, 0, -4), (0, 0, 0)), np.full((8, 12, 3), 90, np.uint8)
    )
    for x in (-1.0, 0.0, 1.0)
)
DATASET = Dataset("views", VIEWS[:2], VIEWS[2:], np.zeros((2, 3)), np.full((2, 3), 99, np.uint8))
SETTINGS = TrainSettings(iterations=1, max_splats=10)
POSES = np.array([[0, 0, 0, 1, 0, 0, 0.0]])


@cache
def _rig() -> Rig:
    return Rig(fs.Scene([CLOUD]), {0: "box"}, {"eye": CAMERA}, renderer=RENDERER)


@cache
def _rig_images() -> Any:
    return _rig().render({"box": POSES})


@cache
def _store(folder: Path) -> fs.Store:
    fs.save_ply(CLOUD, folder / "stored.ply")
    return fs.Store(fs.build_store([folder / "stored.ply"], folder / "stored.fss", overwrite=True))


@cache
def _image_folder(folder: Path) -> Path:
    """A data set of VIEWS."""
    poses = np.stack([np.linalg.inv(view.camera.world_to_camera) for view in VIEWS])
    names = [f"{number}.png" for number in range(len(VIEWS))]
    for view, name in zip(VIEWS, names, strict=True):
        image_files.write_png(folder / name, view.image)
    fs.save_trajectory(
        fs.Trajectory(range(len(VIEWS)), poses), folder / "transforms.json", VIEWS[0].camera, names
    )
    return folder


@cache
def _two_devices() -> fs.SeveralDevices:
    return fs.SeveralDevices(["reference", "reference"])


def _log(method: str, **given: Any) -> Callable[[Path], Call]:
    """A message of a RobotLog."""

    def call(folder: Path) -> Call:
        from fidsplat.logs import RobotLog

        def write(**given: Any) -> None:
            with RobotLog(folder / "log.mcap", overwrite=True) as log:
                getattr(log, method)(**given)

        return write, given, None

    return call


def _robot_log(folder: Path) -> Call:
    from fidsplat.logs import RobotLog

    return (
        RobotLog,
        {"path": folder / "log.mcap", "world": "map", "overwrite": True, "source": ""},
        lambda log: log.__exit__(ValueError),
    )


CALLS: dict[str, Callable[[Path], Call]] = {
    "SplatCloud.half_extents": lambda _: (CLOUD.half_extents, {"sigmas": 3.0}, None),
    "Camera.project of several": lambda _: (fs.Camera.equirectangular(24, 12).project, {"points": MEANS}, None),
    "Fisheye.image": lambda _: (fs.Fisheye(0.1).image, {"points": MEANS}, None),
    "Fisheye.rays": lambda _: (fs.Fisheye(0.1).rays, {"image": MEANS[:, :2]}, None),
    "BrownConrady.derivative": lambda _: (fs.BrownConrady(0.1).derivative, {"points": MEANS}, None),
    "Motion.sampled": lambda _: (fs.Motion(PATH).sampled, {"times": [0.0, 1.0]}, None),
    "TrainSettings.adam_steps": lambda _: (SETTINGS.adam_steps, {"iteration": 3}, None),
    "TrainSettings.densifies_after": lambda _: (SETTINGS.densifies_after, {"iteration": 3}, None),
    "TrainSettings.surface_weights_at": lambda _: (SETTINGS.surface_weights_at, {"iteration": 3}, None),
    "DifferentiableFrame.backward": lambda _: (
        RENDERER.render_differentiable(CLOUD, CAMERA).backward,
        {"gradients": {"rgb": np.ones((16, 24, 3), np.float32)}, "on_device": False},
        None,
    ),
    "DifferentiableFrame.backward of": lambda _: (
        lambda rgb: RENDERER.render_differentiable(CLOUD, CAMERA).backward({"rgb": rgb}),
        {"rgb": np.ones((16, 24, 3), np.float32)},
        None,
    ),
    "BrownConrady.opencv": lambda _: (fs.BrownConrady.opencv, {"coefficients": (0.1, 0, 0, 0)}, None),
    "focal_length": lambda _: (fs.cameras.focal_length, {"width": 24, "fov_x": 1.0}, None),
    "look_at_matrix": lambda _: (fs.cameras.look_at_matrix, {"position": (0, 0, -1), "target": (0, 0, 0), "up": (0, -1, 0)}, None),
    "Trajectory()": lambda _: (PATH, {"time": 0.5}, None),
    "Trajectory.sampled": lambda _: (PATH.sampled, {"rate": 3.0}, None),
    "Motion.camera_at": lambda _: (fs.Motion(PATH).camera_at, {"time": 0.5}, None),
    "Motion.groups_at": lambda _: (fs.Motion(groups={0: PATH}).groups_at, {"time": 0.5}, None),
    "Motion.moved": lambda _: (fs.Motion(PATH).moved, {"camera": CAMERA, "time": 0.5}, None),
    "Shutter.bands": lambda _: (fs.Shutter(readout=0.1).bands, {"height": 9}, None),
    "Shutter.times": lambda _: (fs.Shutter(exposure_time=0.1, sub_poses=3).times, {"middle": 0.5}, None),
    "ExternalDepth": lambda _: (
        fs.ExternalDepth, {"rgb": np.ones((16, 24, 3)), "depth": np.ones((16, 24)), "label": 0},
        lambda external_depth: RENDERER.render(CLOUD, CAMERA, external_depth=external_depth),
    ),
    "Renderer.render_subsampled": lambda _: (
        RENDERER.render_subsampled, {"step": 4, "scene": CLOUD, "capture": CAMERA, "outputs": ("rgb",), "quality": None, "progress": None}, None
    ),
    "Renderer.render_band": lambda _: (
        RENDERER.render_band, {"band": (2, 4), "scene": CLOUD, "capture": CAMERA, "outputs": ("rgb",), "quality": None}, None
    ),
    "Frame.read_rows": lambda _: (_frame().read_rows, {"name": "rgb", "first": 1, "end": 3, "into": None}, None),
    "FrameBatch.frame": lambda _: (RENDERER.render_batch(CLOUD, [CAMERA]).frame, {"number": 0}, dict),
    "SeveralDevices": lambda _: (fs.SeveralDevices, {"devices": ["reference"], "memory_budget": None}, None),
    "SeveralDevices.upload": lambda _: (_two_devices().upload, {"scene": CLOUD}, None),
    "SeveralDevices.render": lambda _: (
        _two_devices().render, {"scene": CLOUD, "capture": CAMERA, "outputs": ("rgb",), "quality": None}, dict
    ),
    "SeveralDevices.render_views": lambda _: (
        _two_devices().render_views, {"scene": CLOUD, "captures": [CAMERA], "outputs": ("rgb",), "quality": None}, _rows
    ),
    "Store": lambda folder: (fs.Store, {"path": _store(folder).path}, None),
    "Store.bounds": lambda folder: (_store(folder).bounds, {"sigmas": 3.0}, None),
    "Store.bounding_boxes": lambda folder: (_store(folder).bounding_boxes, {"sigmas": 3.0}, None),
    "Store.load": lambda folder: (_store(folder).load, {"number": 0, "placed": True}, None),
    "Store.counts": lambda folder: (_store(folder).counts, {"numbers": np.array([0])}, None),
    "Store.first_of": lambda folder: (_store(folder).first_of, {"numbers": np.array([0])}, None),
    "Store.cell_sizes": lambda folder: (_store(folder).cell_sizes, {"quality": fs.Quality()}, None),
    "Store.verify": lambda folder: (_store(folder).verify, {"progress": None}, None),
    "build_store": lambda folder: (
        fs.build_store,
        {
            "inputs": [_store(folder).path.parent / "stored.ply"], "out": folder / "built.fss", "chunk": 64, "memory": 2**28,
            "levels": True, "sh_degree": None, "colors": "float32", "overwrite": True, "progress": None,
        },
        None,
    ),
    "place_store": lambda folder: (
        fs.place_store, {"store": _store(folder), "out": folder / "placed.fss", "poses": [np.eye(4)], "overwrite": True}, None
    ),
    "TrainingView": lambda _: (
        TrainingView, {"name": "a", "camera": VIEWS[0].camera, "image": VIEWS[0].image, "mask": np.ones((8, 12), bool)}, None
    ),
    "Dataset": lambda _: (
        Dataset,
        {
            "name": "a", "views": VIEWS[:2], "held_out": VIEWS[2:], "points": np.zeros((2, 3)),
            "colors": np.full((2, 3), 99, np.uint8), "background": (0.0, 0.0, 0.0),
        },
        lambda made: (made.digest, made.extent, Trainer(made, RENDERER, SETTINGS).step()),
    ),
    "Dataset.with_random_points": lambda _: (DATASET.with_random_points, {"count": 3, "seed": 0}, None),
    "TrainSettings": lambda _: (
        TrainSettings,
        {
            "iterations": 1, "strategy": "default", "max_splats": 10, "sh_degree": 1, "seed": 0, "quality": "surfel", "position_rate": 1e-3,
            "prune_scale": 0.1,
        },
        lambda made: Trainer(DATASET, RENDERER, made).step(),
    ),
    "TrainSettings.degree_at": lambda _: (SETTINGS.degree_at, {"iteration": 5}, None),
    "Trainer": lambda folder: (
        Trainer,
        {"dataset": DATASET, "renderer": RENDERER, "settings": SETTINGS, "checkpoint": None, "start": None, "restart": True, "seed": 0},
        lambda trainer: trainer.step(),
    ),
    "Trainer.run": lambda _: (Trainer(DATASET, RENDERER, SETTINGS).run, {"progress": None, "prompt": True}, None),
    "Trainer.save": lambda folder: (Trainer(DATASET, RENDERER, SETTINGS).save, {"path": folder / "trained.ply"}, None),
    "Trainer.evaluate": lambda _: (Trainer(DATASET, RENDERER, SETTINGS).evaluate, {"views": VIEWS}, None),
    "load_dataset": lambda folder: (
        load_dataset, {"path": _image_folder(folder), "hold_out": None, "random_points": 3, "seed": 0, "progress": None}, None
    ),
    "splats_within": lambda _: (splats_within, {"settings": SETTINGS, "budget": 2**30, "dataset": DATASET}, None),
    "refine": lambda _: (
        partial(refine, iterations=1), {"marker": TAG, "renderer": RENDERER, "leak": 0.05, "seed": 0, "progress": None}, None
    ),
    "RigCamera": lambda _: (
        RigCamera, {"camera": CAMERA, "body": None, "sensor": None, "outputs": ("rgb",), "rate": 30.0},
        lambda camera: Rig(fs.Scene([CLOUD]), {}, {"eye": camera}, renderer=RENDERER),
    ),
    "Rig": lambda _: (
        Rig,
        {
            "scene": fs.Scene([CLOUD]), "bodies": {0: "box"}, "cameras": {"eye": CAMERA}, "renderer": RENDERER,
            "rest": {"box": POSES[0]}, "outputs": ("rgb",),
        },
        None,
    ),
    "Rig.render": lambda _: (
        _rig().render,
        {"bodies": {"box": POSES}, "cameras": {"eye": POSES}, "outputs": ("rgb",), "external_depths": None, "mask": np.array([True])},
        dict,
    ),
    "Rig.outputs_of": lambda _: (_rig().outputs_of, {"camera": "eye"}, None),
    "Rig.placed": lambda _: (_rig().placed, {"bodies": {"box": POSES[0]}}, None),
    "RigImages.camera": lambda _: (_rig_images().camera, {"name": "eye", "environment": 0}, None),
    "RigImages.of": lambda _: (_rig_images().of, {"camera": "eye"}, None),
    "RigImages.placed": lambda _: (_rig_images().placed, {"environment": 0}, None),
    "RigImages[]": lambda _: (_rig_images().__getitem__, {"name": "rgb"}, None),
    "read_description": lambda folder: (read_description, {"path": folder / "none.sdf", "models": ()}, None),
    "read_back": lambda _: (read_back, {"frame": np.zeros((16, 24, 3), np.uint8), "scene": fs.Scene(markers=[PlacedMarker(TAG)]), "camera": CAMERA}, None),
    "truth_of": lambda _: (truth_of, {"frame": _frame(), "scene": fs.Scene(markers=[PlacedMarker(TAG)]), "camera": CAMERA}, None),
    "points_of": lambda _: (points_of, {"depth": np.ones((16, 24)), "camera": CAMERA}, None),
    "optical_flow": lambda _: (
        optical_flow, {"depth": np.ones((16, 24)), "before": CAMERA, "after": CAMERA, "label": None, "motions": None}, None
    ),
    "CocoAnnotations.add": lambda _: (
        lambda **given: CocoAnnotations().add(**given), {"file_name": "a.png", "truth": truth_of(_frame(), fs.Scene([CLOUD]), CAMERA)}, None
    ),
    "CocoAnnotations.save": lambda folder: (CocoAnnotations().save, {"path": folder / "truth.json"}, None),
    "RobotLog": _robot_log,
    "RobotLog.image": _log("image", time=0.0, camera="eye", image=np.zeros((4, 4, 3)), output="rgb", compress=None),
    "RobotLog.image of depth": _log("image", time=0.0, camera="eye", image=np.zeros((4, 4)), output="depth"),
    "RobotLog.image compressed": _log("image", time=0.0, camera="eye", image=np.zeros((4, 4, 3)), compress="png"),
    "RobotLog.camera_info": _log("camera_info", time=0.0, name="eye", camera=CAMERA),
    "RobotLog.transform": _log("transform", time=0.0, frame="eye", pose=np.eye(4), parent=None),
    "RobotLog.odometry": _log(
        "odometry", time=0.0, pose=np.eye(4), velocity=(0, 0, 0), angular_velocity=(0, 0, 0), frame="base", topic="/odom", covariance=np.eye(6)
    ),
    "RobotLog.imu": _log("imu", time=0.0, angular_velocity=(0, 0, 0), acceleration=(0, 0, 0), frame="imu_link", topic="/imu/data_raw"),
    "RobotLog.clock": _log("clock", time=0.0),
    "RobotLog.camera_pose": _log("camera_pose", time=0.0, camera="eye", pose=np.eye(4), base=None),
    "RobotLog.joint_states": _log("joint_states", time=0.0, names=["left"], positions=[0.0]),
    "RobotLog.detections": _log("detections", time=0.0, camera="eye", found=[]),
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
    "SplatCloud.with_coplanar_groups": lambda _: (CLOUD.with_coplanar_groups, {"groups": 3}, draw),
    "SplatCloud.with_boxes": lambda _: (CLOUD.with_boxes, {"boxes": True}, draw),
    "SplatCloud.transformed": lambda _: (CLOUD.transformed, {"matrix": np.eye(4)}, draw),
    "Camera.pinhole": lambda _: (
        fs.Camera.pinhole,
        {
            "width": 24, "height": 16, "fx": 20.0, "fy": 20.0, "cx": 12.0, "cy": 8.0, "world_to_camera": np.eye(4),
            "near": 0.1, "far": 100.0, "position": None, "lens": None,
        },
        _render_camera,
    ),
    "Camera.look_at": lambda _: (
        fs.Camera.look_at,
        {"width": 24, "height": 16, "fov_x": 1.0, "position": (0, 0, -9), "target": (0, 0, 0), "up": (0, -1, 0)},
        _render_camera,
    ),
    "Camera.fisheye": lambda _: (
        fs.Camera.fisheye, {"width": 24, "height": 16, "fov_x": 2.0}, _render_camera
    ),
    "Camera.orthographic": lambda _: (
        fs.Camera.orthographic, {"width": 24, "height": 16, "metres_wide": 3.0, "near": 0.1, "far": 50.0}, _render_camera
    ),
    "Camera.equirectangular": lambda _: (fs.Camera.equirectangular, {"width": 24, "height": 12}, _render_camera),
    "Camera.from_colmap": lambda _: (
        fs.Camera.from_colmap,
        {"camera": ("PINHOLE", 24, 16, [20.0, 20.0, 12.0, 8.0]), "world_to_camera": np.eye(4)},
        _render_camera,
    ),
    "Camera.from_nerfstudio": lambda _: (
        fs.Camera.from_nerfstudio,
        {"transforms": {"w": 24, "h": 16, "fl_x": 20.0, "frames": [{"transform_matrix": np.eye(4).tolist()}]}, "frame": 0},
        _render_camera,
    ),
    "Camera.with_size": lambda _: (CAMERA.with_size, {"width": 12, "height": 8}, _render_camera),
    "Camera.project": lambda _: (CAMERA.project, {"points": MEANS}, None),
    "Camera.rays": lambda _: (CAMERA.rays, {"pixels": np.ones((2, 2))}, None),
    "BrownConrady": lambda _: (
        fs.BrownConrady,
        {"k1": 0.1, "p1": 0.01, "k4": 0.0, "s2": 0.0},
        lambda lens: _render_camera(fs.Camera.pinhole(24, 16, 20, 20, 12, 8, lens=lens)),
    ),
    "Fisheye": lambda _: (
        fs.Fisheye, {"k1": 0.1, "k4": 0.01}, lambda lens: _render_camera(fs.Camera.pinhole(24, 16, 20, 20, 12, 8, lens=lens))
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
    "to_uint8": lambda _: (image_files.to_uint8, {"image": np.zeros((4, 4, 3))}, None),
    "write_png": lambda folder: (image_files.write_png, {"path": folder / "out.png", "image": np.zeros((4, 4, 3), np.uint8)}, None),
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
