"""Conversion of camera models of COLMAP, nerfstudio and ROS: intrinsics, lenses, axes and pixel
coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras.lenses import BrownConrady, Fisheye, Lens
from fidsplat.util.errors import InputError, unknown

PIXEL_OFFSET = 0.5
"""added to pixel coordinates of ROS, OpenCV and BOP, where the centre of the first pixel is 0, not 0.5"""
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera axes (y up, z backwards) in OpenCV's, and vice versa"""
LINK_FROM_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""REP-103's body axes (x forward, y left, z up) from OpenCV's camera axes"""
_COLMAP: dict[str, tuple[type[BrownConrady | Fisheye], tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (BrownConrady, ()),
    "PINHOLE": (BrownConrady, ()),
    "SIMPLE_RADIAL": (BrownConrady, ("k1",)),
    "RADIAL": (BrownConrady, ("k1", "k2")),
    "OPENCV": (BrownConrady, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (BrownConrady, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": (Fisheye, ("k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": (Fisheye, ("k1",)),
    "RADIAL_FISHEYE": (Fisheye, ("k1", "k2")),
}
"""supported camera models: lens, and its coefficients after the parameters f or fx, fy, and cx, cy"""
_BROWN = ("k1", "k2", "k3", "p1", "p2")
_NERFSTUDIO: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), _BROWN),
    "FULL_OPENCV": (*_BROWN, "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""supported values of `camera_model` with their lens coefficients"""
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
"""coefficients of lenses in transforms.json"""
_ROS: dict[str, tuple[type[BrownConrady | Fisheye], tuple[str, ...]]] = {
    "": (BrownConrady, ()),
    "plumb_bob": (BrownConrady, ("k1", "k2", "p1", "p2", "k3")),
    "rational_polynomial": (
        BrownConrady,
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    ),
    "equidistant": (Fisheye, ("k1", "k2", "k3", "k4")),
}
"""supported values of `distortion_model`: lens and its coefficients in order"""


def opencv_matrix(camera: Any) -> np.ndarray:
    """Intrinsic matrix (3, 3) for the pixel coordinates of ROS, OpenCV and BOP."""
    return camera.matrix - [[0, 0, PIXEL_OFFSET], [0, 0, PIXEL_OFFSET], [0, 0, 0]]


class PinholeArguments(NamedTuple):
    """Arguments of `Camera.pinhole`."""

    width: Any
    height: Any
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Any
    lens: Lens | None


def colmap_arguments(camera: Any, pose: Any) -> PinholeArguments:
    """Arguments of `Camera.pinhole` from pycolmap's camera and image or pose, or from (model, width, height,
    parameters) and a pose."""
    try:
        if hasattr(camera, "params"):
            model = getattr(camera.model, "name", camera.model)
            camera = (model, camera.width, camera.height, camera.params)
        model, width, height, parameter_values = camera
        parameters = [float(number) for number in parameter_values]
    except (AttributeError, TypeError, ValueError):
        raise InputError(
            "camera must be a pycolmap.Camera, or (model, width, height, parameters), "
            f"got {camera!r}; fs.load_cameras reads files"
        ) from None
    if callable(getattr(pose, "cam_from_world", None)):  # pycolmap.Image
        pose = pose.cam_from_world()
    if callable(getattr(pose, "matrix", None)):  # pycolmap.Rigid3d: (3, 4)
        pose = np.vstack([pose.matrix(), (0.0, 0.0, 0.0, 1.0)])
    if not isinstance(model, str) or model not in _COLMAP:
        raise InputError(
            f"the camera model must be one of {', '.join(_COLMAP)}, got {model}; undistort the images, "
            "e.g. by colmap image_undistorter"
        )
    lens_class, names = _COLMAP[model]
    intrinsics = 3 if "SIMPLE" in model or model.startswith("RADIAL") else 4  # f, cx, cy or fx, fy, cx, cy
    if len(parameters) != intrinsics + len(names):
        raise InputError(
            f"the parameters of COLMAP's model {model} must be {'f' if intrinsics == 3 else 'fx, fy'}, cx, cy"
            f"{''.join(f', {name}' for name in names)}, got {len(parameters)} numbers"
        )
    lens = lens_class(**dict(zip(names, parameters[intrinsics:], strict=True)))
    fx, fy, cx, cy = parameters[:intrinsics] if intrinsics == 4 else (parameters[0], *parameters[:3])
    return PinholeArguments(width, height, fx, fy, cx, cy, pose, lens)


def nerfstudio_arguments(transforms: Any, frame: Any) -> PinholeArguments:
    """Arguments of `Camera.pinhole` for a frame of transforms.json, by its index or file_path."""
    try:
        frames = list(transforms["frames"])
        paths = [entry.get("file_path") for entry in frames]
    except (TypeError, KeyError, IndexError, AttributeError):
        raise InputError(
            "transforms must be the content of a transforms.json, with a list of frames, got "
            f"{str(transforms)[:80]!r}; fs.load_cameras reads files"
        ) from None
    number = paths.index(frame) if isinstance(frame, str) and frame in paths else frame
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(frames):
        raise InputError(
            f"frame must be a number from 0 to {len(frames) - 1} or a file_path of transforms, got {frame!r}"
        )
    values = {**transforms, **frames[number]}
    try:
        matrix = np.array(values["transform_matrix"], np.float64)
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, (0, 0, 0, 1)])
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(
            f"transform_matrix must be 4 x 4 finite numbers, got {values.get('transform_matrix')!r}"
        ) from None
    try:
        width, height = int(values["w"]), int(values["h"])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(
            f"w and h must be the size of the images [px], got {values.get('w')!r} and {values.get('h')!r}"
        ) from None
    try:
        fx = _focal_length(values, "x", width)
        fy = _focal_length(values, "y", height) if values.keys() & {"fl_y", "camera_angle_y"} else fx
        cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    except InputError:  # a subclass of ValueError
        raise
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(
            "fl_x, or camera_angle_x, must be a finite number, got "
            f"{values.get('fl_x')!r} and {values.get('camera_angle_x')!r}"
        ) from None
    pose = matrix @ OPENGL_AXES
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return PinholeArguments(width, height, fx, fy, cx, cy, world_to_camera, _nerfstudio_lens(values))


def _focal_length(values: Mapping[str, Any], axis: str, pixels: int) -> float:
    if f"fl_{axis}" in values:
        return float(values[f"fl_{axis}"])
    angle = float(values[f"camera_angle_{axis}"])
    if not 0 < angle < math.pi:
        raise InputError(f"camera_angle_{axis} must be between 0 and pi radians, got {angle:g}")
    return pixels / 2 / math.tan(angle / 2)


def ros_arguments(info: Any, world_to_camera: Any, rectified: bool) -> PinholeArguments:
    """Arguments of `Camera.pinhole` from a sensor_msgs/CameraInfo, or a ROS calibration file as a dict."""
    try:
        if isinstance(info, Mapping):
            width, height = info["image_width"], info["image_height"]
            k, p = (info[f"{name}_matrix"]["data"] for name in ("camera", "projection"))
            factors, model = info["distortion_coefficients"]["data"], info["distortion_model"]
            reduced = False
        else:  # ROS 1 names the fields K, D and P
            k, d, p = (getattr(info, name, None) for name in "kdp")
            k, factors, p = (
                getattr(info, name.upper()) if v is None else v
                for name, v in zip("kdp", (k, d, p), strict=True)
            )
            width, height, model = info.width, info.height, info.distortion_model
            reduced = max(info.binning_x, info.binning_y) > 1 or info.roi.x_offset or info.roi.y_offset
        matrix = np.array(p, np.float64).reshape(3, 4) if rectified else np.array(k, np.float64).reshape(3, 3)
        coefficients = [] if rectified else [float(number) for number in factors]
    except (AttributeError, KeyError, IndexError, TypeError, ValueError):
        raise InputError(
            "info must be a sensor_msgs/CameraInfo, or the dict of a calibration file with image_width, "
            f"camera_matrix and so on, got {type(info).__name__}"
        ) from None
    if reduced:
        raise InputError(
            "info must describe the complete image, got binning or a region of interest; publish the "
            "complete image"
        )
    if model not in _ROS:
        raise InputError(unknown("distortion_model of CameraInfo", model, tuple(filter(None, _ROS))))
    kind, names = _ROS[model]
    if any(coefficients[len(names) :]):
        raise InputError(
            f"the coefficients d of {model or 'no model'} must be {', '.join(names) or 'none'}, got "
            f"{coefficients}; rectify the images, and set rectified=True"
        )
    lens = None if rectified else kind(**dict(zip(names, coefficients, strict=False)))
    (fx, _, cx), (_, fy, cy) = matrix[0, :3], matrix[1, :3]
    cx, cy = cx + PIXEL_OFFSET, cy + PIXEL_OFFSET
    return PinholeArguments(width, height, fx, fy, cx, cy, world_to_camera, lens)


def _nerfstudio_lens(values: Mapping[str, Any]) -> Lens:
    model = values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") else "PINHOLE")
    if not isinstance(model, str) or model not in _NERFSTUDIO:
        raise InputError(
            f"camera_model must be one of {', '.join(_NERFSTUDIO)}, got {model!r}; undistort the images first"
        )
    coefficients = {name: values[name] for name in COEFFICIENTS if values.get(name)}
    if others := coefficients.keys() - _NERFSTUDIO[model]:
        name = min(others)
        raise InputError(
            f"coefficients of the camera_model {model} must be {', '.join(_NERFSTUDIO[model])}, got {name} = "
            f"{coefficients[name]!r}; undistort the images first"
        )
    return (Fisheye if model == "OPENCV_FISHEYE" else BrownConrady)(**coefficients)
