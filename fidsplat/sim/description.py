"""Cameras and bodies of SDF worlds and models, and of URDF robots."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fidsplat.cameras import Camera, focal_length
from fidsplat.sim.camera_element import (
    KINDS,
    ElementPath,
    camera_sensor,
    name_of,
    numbers,
    parse,
    pose_element,
    pose_of_angles,
)
from fidsplat.sim.poses import IDENTITY, OPTICAL, compose, inverse, matrix_of
from fidsplat.sim.rig import RigCamera
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import path_of

DEEPEST = 32
"""maximum nesting depth of includes and of models"""


@dataclass
class Description:
    """Cameras, bodies and splats of a description file."""

    cameras: dict[str, RigCamera] = field(default_factory=dict)
    """cameras by the sensor's name, for `Rig`; each is attached to its link"""
    bodies: dict[str, np.ndarray] = field(default_factory=dict)
    """poses (7,) of links in the world by name, MODEL::LINK in SDF; of a robot with all joints at 0"""

    def add(self, name: str, camera: RigCamera | None, where: ElementPath) -> None:
        """Add a camera. Raises InputError for a name that exists."""
        if camera is None:
            return
        if name in self.cameras:
            raise where.error(
                f"two cameras have the name {name!r}, on {self.cameras[name].body} and on {camera.body}; "
                "rename one"
            )
        self.cameras[name] = camera


def read_description(
    path: str | os.PathLike[str],
    models: Iterable[str | os.PathLike[str]] = (),
    max_models: int = 10_000,
) -> Description:
    """Read the cameras and links of an SDF or URDF file.

    SDF: nested models and includes, poses relative to links, frames and joints of the same model; sensors
    that are cameras, with field of view or intrinsics, distortion, clip, noise and update rate. URDF: links,
    joints at 0, sensors within `<gazebo reference>`, and `<sensor>` elements.

    Args:
        path: the file, or a model's folder with model.sdf in it.
        models: folders that are searched for `model://NAME` before those of the environment variables
            GZ_SIM_RESOURCE_PATH and SDF_PATH and the file's folder.
        max_models: maximum number of models of an SDF file with all includes; a few lines can include
            millions.

    Raises:
        InputError: a file that cannot be read, too many or too deeply nested models, an include that is not
            found or includes itself, an invalid camera, two cameras of one name; the message names the file
            and the element.
    """
    file = path_of(path)
    if file.is_dir():
        file = file / "model.sdf"
    root, where = parse(file)
    description = Description()
    if root.tag == "robot":
        _read_robot(root, description, where)
    elif root.tag == "sdf":
        folders = [Path(folder) for folder in models]
        for variable in ("GZ_SIM_RESOURCE_PATH", "SDF_PATH"):
            folders += [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
        reader = _Sdf(description, folders, max_models)
        reader.group(root, "", IDENTITY, where, ())
        for world in root.findall("world"):
            reader.group(world, "", IDENTITY, where.child("world"), ())
    else:
        raise where.error(f"the root must be <sdf> or <robot>, got <{root.tag}>")
    return description


@dataclass
class _Sdf:
    found: Description
    folders: list[Path]
    max_models: int
    models: int = 0
    parsed: dict[Path, tuple[ElementTree.Element, ElementPath]] = field(default_factory=dict)
    """cached files of includes"""

    def group(
        self,
        parent: ElementTree.Element,
        prefix: str,
        at: np.ndarray,
        where: ElementPath,
        files: tuple[Path, ...],
    ) -> None:
        """Read the models and includes of a world, a model or a file."""
        for model in parent.findall("model"):
            self.model(model, prefix, at, where, files)
        for include in parent.findall("include"):
            self.include(include, prefix, at, where, files)

    def include(
        self,
        include: ElementTree.Element,
        prefix: str,
        at: np.ndarray,
        where: ElementPath,
        files: tuple[Path, ...],
    ) -> None:
        uri = include.findtext("uri", "").strip()
        where = where.child(f"include {uri}")
        file = self._file_of(uri, where)
        if file in files or len(files) >= DEEPEST:
            raise where.error("an include must not include itself; remove it")
        if file not in self.parsed:
            self.parsed[file] = parse(file)
        root, inner = self.parsed[file]
        model = root.find("model")
        if model is None:
            raise inner.error("an included file must have a <model>, got none")
        pose = None if include.find("pose") is None else pose_element(include, where)
        name = include.findtext("name", "").strip() or None
        self.model(model, prefix, at, inner, (*files, file), name, pose)

    def _file_of(self, uri: str, where: ElementPath) -> Path:
        name = uri.removeprefix("model://").removeprefix("file://")
        parent = where.file.resolve().parent
        for folder in (*self.folders, parent, parent.parent):
            for candidate in (folder / name, folder / name / "model.sdf"):
                if name and candidate.is_file():
                    return candidate.resolve()
        places = ", ".join(map(str, (*self.folders, parent, parent.parent)))
        raise where.error(f"cannot find the model in {places}; give its folder as models=[...]")

    def model(
        self,
        model: ElementTree.Element,
        prefix: str,
        at: np.ndarray,
        where: ElementPath,
        files: tuple[Path, ...],
        name: str | None = None,
        pose: np.ndarray | None = None,
    ) -> None:
        """Read one model. at: pose of the parent. name, pose: of an include; they replace those of the
        model."""
        model_name = name or name_of(model, where)
        where = where.child(model_name)
        self.models += 1
        if self.models > self.max_models:
            raise where.error(
                f"the file must have at most {self.max_models:,} models with its includes, got more; "
                "read_description(..., max_models=N) allows N"
            )
        if prefix.count("::") >= DEEPEST:
            raise where.error(f"models must be nested at most {DEEPEST} deep, got more; flatten them")
        here = compose(at, pose_element(model, where) if pose is None else pose)
        frames = _Frames(model, where)
        for link in model.findall("link"):
            body = f"{prefix}{model_name}::{name_of(link, where)}"
            within = where.child(name_of(link, where))
            self.found.bodies[body] = compose(here, frames.pose(link.get("name", "")))
            for sensor in link.findall("sensor"):
                sensed = name_of(sensor, within)
                inside = within.child(sensed)
                camera = camera_sensor(sensor, body, pose_element(sensor, inside), inside)
                self.found.add(sensed, camera, inside)
        self.group(model, f"{prefix}{model_name}::", here, where, files)


class _Frames:
    """Poses of a model's links, frames and joints relative to the model."""

    def __init__(self, model: ElementTree.Element, where: ElementPath) -> None:
        kinds = ("link", "frame", "joint", "model")
        self._parts = {part.get("name", ""): part for kind in kinds for part in model.findall(kind)}
        self._where = where

    def pose(self, name: str, visited: tuple[str, ...] = ()) -> np.ndarray:
        """Pose (7,) of a part, model from part."""
        if name == "__model__":
            return IDENTITY
        if name not in self._parts:
            raise self._where.error(unknown("frame", name, self._parts))
        if name in visited:
            raise self._where.error(f"the pose of {name!r} must not be relative to itself")
        part = self._parts[name]
        relative = pose_element(part, self._where.child(name))
        element = part.find("pose")
        base = "" if element is None else element.get("relative_to", "")
        if not base:
            base = part.get("attached_to", "") if part.tag == "frame" else ""
            base = part.findtext("child", "").strip() if part.tag == "joint" else base
        return compose(self.pose(base, (*visited, name)), relative) if base else relative


def _read_robot(root: ElementTree.Element, description: Description, where: ElementPath) -> None:
    parents: dict[str, tuple[str, np.ndarray]] = {}
    for joint in root.findall("joint"):
        inside = where.child(name_of(joint, where))
        parent, child = (_link_of(joint, tag, inside) for tag in ("parent", "child"))
        if child in parents:
            raise inside.error(f"the link {child!r} must have one parent, got two")
        parents[child] = parent, _origin(joint, inside)
    links = [name_of(link, where) for link in root.findall("link")]
    for name in links:
        pose, at = IDENTITY, name
        for _ in range(len(links) + 1):
            if at not in parents:
                break
            at, step = parents[at]
            pose = compose(step, pose)
        else:
            raise where.error(f"the joints above the link {name!r} must not form a cycle")
        description.bodies[name] = pose
    for gazebo in root.findall("gazebo"):
        link = gazebo.get("reference", "")
        for sensor in gazebo.findall("sensor"):
            inside = where.child(link).child(name_of(sensor, where))
            if link not in links:
                raise inside.error(unknown("link", link, links))
            camera = camera_sensor(sensor, link, pose_element(sensor, inside), inside)
            description.add(sensor.get("name", ""), camera, inside)
    for sensor in root.findall("sensor"):
        inside = where.child(name_of(sensor, where))
        if sensor.find("camera/image") is not None:
            link = _link_of(sensor, "parent", inside)
            if link not in links:
                raise inside.error(unknown("link", link, links))
            description.add(sensor.get("name", ""), _own_camera(sensor, link, inside), inside)


def _link_of(element: ElementTree.Element, tag: str, where: ElementPath) -> str:
    child = element.find(tag)
    name = "" if child is None else child.get("link", "")
    if not name:
        raise where.error(f"<{tag}> must name a link, got none")
    return name


def _origin(element: ElementTree.Element, where: ElementPath) -> np.ndarray:
    origin, where = element.find("origin"), where.child("origin")
    if origin is None:
        return IDENTITY
    return pose_of_angles(
        numbers(origin.get("xyz", "0 0 0"), 3, where), numbers(origin.get("rpy", "0 0 0"), 3, where)
    )


def _own_camera(sensor: ElementTree.Element, link: str, where: ElementPath) -> RigCamera:
    """Camera of a URDF `<sensor>`."""
    image = sensor.find("camera/image")
    assert image is not None
    inside = where.child("camera/image")

    def attribute(name: str, default: str | None = None) -> float:
        return numbers(image.get(name, default), 1, inside.child(name))[0]

    mount = compose(_origin(sensor, where), OPTICAL)
    width, height = int(attribute("width")), int(attribute("height"))
    try:
        f = focal_length(width, attribute("hfov"))
        near, far = attribute("near", "0.01"), attribute("far") if image.get("far") else math.inf
        camera = Camera(width, height, f, f, width / 2, height / 2, matrix_of(inverse(mount)), near, far)
    except InputError as error:
        raise error if str(error).startswith(str(where.file)) else inside.error(str(error)) from None
    rate = sensor.get("update_rate")
    outputs = KINDS.get(sensor.get("type", "camera"), ("rgb",))
    return RigCamera(camera, link, None, outputs, numbers(rate, 1, where)[0] if rate else None)
