"""XML parsing shared by SDF and URDF: numbers, poses and SDF's `<camera>` element."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Fisheye, fisheye_focal_length, focal_length
from fidsplat.capture.sensor import Sensor
from fidsplat.sim.poses import IDENTITY, OPTICAL, check_poses, compose, inverse, matrix_of
from fidsplat.sim.rig import RigCamera
from fidsplat.splats.rotations import quaternion_multiply
from fidsplat.util.errors import InputError
from fidsplat.util.files import open_input, path_of

KINDS = {
    "camera": ("rgb",),
    "wideanglecamera": ("rgb",),
    "depth_camera": ("depth",),
    "depth": ("depth",),
    "rgbd_camera": ("rgb", "depth"),
    "rgbd": ("rgb", "depth"),
    "segmentation": ("label",),
    "segmentation_camera": ("label",),
    "boundingbox_camera": ("rgb", "label"),
}
"""outputs of each type of sensor"""
_WELL = 1e12
"""full well [electrons] that makes shot noise negligible"""


@dataclass(frozen=True)
class ElementPath:
    """Path of an element within a file, for error messages."""

    file: Path
    path: str = ""

    def child(self, name: str) -> ElementPath:
        """The path of a child element."""
        return ElementPath(self.file, f"{self.path}/{name}" if self.path else name)

    def error(self, why: str) -> InputError:
        """An InputError with the file, the element and the reason."""
        return InputError(f"{self.file}: {self.path}: {why}" if self.path else f"{self.file}: {why}")


def parse(path: str | os.PathLike[str]) -> tuple[ElementTree.Element, ElementPath]:
    """Root element of an XML file. Raises InputError for a file that cannot be read or parsed."""
    file = path_of(path)
    try:
        with open_input(file) as stream:
            root = ElementTree.parse(stream).getroot()
    except InputError:
        raise
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # or an unknown encoding
        raise InputError(f"cannot read {file} as XML: {error}; correct the file") from None
    for element in root.iter():
        if "ros.org/wiki/xacro" in str(element.tag):
            raise InputError(
                f"{file} must be URDF, got xacro; run `xacro {file.name} > out.urdf` and read that"
            )
    return root, ElementPath(file)


def name_of(element: ElementTree.Element, where: ElementPath) -> str:
    """The required attribute `name` of an element."""
    name = element.get("name", "")
    if not name:
        raise where.error(f"a <{element.tag}> must have a name, got none")
    return name


def numbers(text: str | None, count: int, where: ElementPath) -> list[float]:
    """Parse `count` finite numbers."""
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise where.error(f"the text must be {count} finite number{'s' if count > 1 else ''}, got {text!r}")
    return values


def number(parent: ElementTree.Element, tag: str, default: float, where: ElementPath) -> float:
    """The number in an optional child element."""
    child = parent.find(tag)
    return default if child is None else numbers(child.text, 1, where.child(tag))[0]


def pose_of_angles(position: list[float], angles: list[float]) -> np.ndarray:
    """Pose (7,) from x y z and roll, pitch, yaw in radians about the fixed axes x, y, z."""
    rotation = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in enumerate(angles):
        about_axis = np.zeros(4)
        about_axis[0], about_axis[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
        rotation = quaternion_multiply(about_axis, rotation)
    return np.array([*position, *rotation])


def pose_element(parent: ElementTree.Element, where: ElementPath) -> np.ndarray:
    """Pose (7,) of a child `<pose>`, by default the identity."""
    element, where = parent.find("pose"), where.child("pose")
    if element is None or not (element.text or "").strip():
        return IDENTITY
    if element.get("rotation_format", "euler_rpy") == "quat_xyzw":
        x, y, z, qx, qy, qz, qw = numbers(element.text, 7, where)
        return check_poses(f"{where.file}: {where.path}", [x, y, z, qw, qx, qy, qz], ())
    values = numbers(element.text, 6, where)
    unit = math.radians(1) if element.get("degrees", "false").lower() in ("true", "1") else 1.0
    return pose_of_angles(values[:3], [unit * angle for angle in values[3:]])


def camera_sensor(
    sensor: ElementTree.Element, body: str, at: np.ndarray, where: ElementPath
) -> RigCamera | None:
    """Camera of an SDF `<sensor>`; None if the sensor is not a camera.

    body: name of the sensor's link. at: (7,) link from sensor.
    """
    kind = sensor.get("type", "")
    element = sensor.find("camera")
    if kind not in KINDS or element is None:
        return None
    where = where.child("camera")
    mount = compose(compose(at, pose_element(element, where)), OPTICAL)
    plain = _camera(element, where)
    camera = Camera(
        plain.width, plain.height, plain.fx, plain.fy, plain.cx, plain.cy,
        matrix_of(inverse(mount)), plain.near, plain.far, lens=plain.lens,
    )  # fmt: skip
    rate = number(sensor, "update_rate", 0.0, where)
    return RigCamera(camera, body, _noise(element, where), KINDS[kind], rate if rate > 0 else None)


def _camera(element: ElementTree.Element, where: ElementPath) -> Camera:
    image = element.find("image")
    sizes = [("width", 320), ("height", 240)]
    width, height = (d if image is None else number(image, tag, d, where.child("image")) for tag, d in sizes)
    if not (width == int(width) and height == int(height)):
        raise where.child("image").error(
            f"width and height must be whole numbers of pixels, got {width:g} x {height:g}"
        )
    fov = number(element, "horizontal_fov", 1.047, where)
    kind = element.findtext("lens/type", "gnomonical").strip()
    lens: Fisheye | BrownConrady | None
    try:
        if kind == "equidistant":
            lens = Fisheye()
            focal = fisheye_focal_length(int(width), fov, lens)
        elif kind == "gnomonical":
            lens = _distortion(element, where)
            focal = focal_length(int(width), fov)
        else:
            raise InputError(f"the type of a lens must be gnomonical or equidistant, got {kind!r}")
        intrinsics, inside = element.find("lens/intrinsics"), where.child("lens/intrinsics")
        values = (("fx", focal), ("fy", focal), ("cx", width / 2), ("cy", height / 2))
        fx, fy, cx, cy = (
            value if intrinsics is None else number(intrinsics, tag, value, inside) for tag, value in values
        )
        clip, inside = element.find("clip"), where.child("clip")
        near = 0.01 if clip is None else number(clip, "near", 0.01, inside)
        far = math.inf if clip is None else number(clip, "far", math.inf, inside)
        return Camera(int(width), int(height), fx, fy, cx, cy, near=near, far=far, lens=lens)
    except InputError as error:
        raise error if str(error).startswith(str(where.file)) else where.error(str(error)) from None


def _distortion(element: ElementTree.Element, where: ElementPath) -> BrownConrady | None:
    distortion, where = element.find("distortion"), where.child("distortion")
    if distortion is None:
        return None
    return BrownConrady(
        **{tag: number(distortion, tag, 0.0, where) for tag in ("k1", "k2", "k3", "p1", "p2")}
    )


def _noise(element: ElementTree.Element, where: ElementPath) -> Sensor | None:
    noise, where = element.find("noise"), where.child("noise")
    if noise is None:
        return None
    mean, deviation = number(noise, "mean", 0.0, where), number(noise, "stddev", 0.0, where)
    if mean:
        raise where.error(f"the mean of the noise must be 0, got {mean:g}")
    if not 0 <= deviation <= 1:
        raise where.error(f"the stddev of the noise must be from 0 to 1 (white), got {deviation:g}")
    return Sensor(full_well=_WELL, read_noise=deviation * _WELL) if deviation else None
