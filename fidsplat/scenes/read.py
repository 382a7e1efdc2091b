"""Reader of scene files in TOML."""

import math
import os
import re
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import Camera, Trajectory, look_at_matrix
from fidsplat.capture.environment import Fog
from fidsplat.capture.quality import MarkerQuality, Quality, setting_types
from fidsplat.capture.sensor import Sensor
from fidsplat.formats import load_splats
from fidsplat.markers.surfaces import SHAPES, SheetShape
from fidsplat.markers.wear import Wear
from fidsplat.scenes.camera import POSE, TABLES, read_focal_lengths, read_keyframes, read_lens, read_shutter
from fidsplat.scenes.environment import read_background, read_part, read_quality
from fidsplat.scenes.lights import read_lighting, read_lights
from fidsplat.scenes.parts import PlacedMarker
from fidsplat.scenes.table import Table, names_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.store.layout import SUFFIX
from fidsplat.store.store import Store
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of, read_input
from fidsplat.util.limits import check_total
from fidsplat.util.progress import Progress

MAX_BYTES = 16 * 2**20
MAX_PARTS = 8
"""maximum number of parts of a dotted key, for which tomllib needs quadratic time and memory; scene files
have at most three"""
TOP = ("camera", "splats", "markers", "render", "quality", "sensor", "fog", "background", "lights")
CAMERA = ("width", "height", "fov_x_deg", "fx", "fy", "cx", "cy")
CAMERA += ("position", "look_at", "up", "world_to_camera", "near", "far", *TABLES, "shutter", "motion")
CAMERA_POSE = ("position", "look_at", "up", "world_to_camera")
SPLATS = ("file", "position", "quaternion", "scale", "motion")
MARKER = (
    "spec",
    "size",
    "position",
    "quaternion",
    "quiet_zone",
    "max_splats",
    "black",
    "white",
    "motion",
    "bundle",
    "light",
    "shape",
    "wear",
)
MARKERS = (*MARKER, *setting_types(MarkerQuality))
RENDER = ("outputs", "background", "quality", "samples", "lowpass", "first_hit", "device")

# Matches a dotted key of too many parts, and strings and comments in order to skip them. Quantifiers are
# possessive and unclosed strings extend to the end of the file, so that the time is linear.
_BASIC, _LITERAL = r'"(?:[^"\\\n]|\\.)*+"?', r"'[^'\n]*+'?"
_LONG_KEY = re.compile(
    r"[\s\[\]{}=,]++"
    r'|"""(?:[^"\\]|\\.|"(?!""))*+(?:"""|\Z)'
    r"|'{3}(?:[^']|'(?!''))*+(?:'{3}|\Z)"
    rf"|(?P<long>(?<![\w.-])(?:(?:[\w-]++|{_BASIC}|{_LITERAL})[ \t]*+\.[ \t]*+){{{MAX_PARTS}}})"
    rf"|{_BASIC}|{_LITERAL}|#[^\n]*+",
    re.DOTALL,
)


def read_scene(
    path: str | os.PathLike[str],
    quality: Quality | str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Read the fields of `SceneParts` from a scene file and the files that it names, relative to its folder.

    quality: replaces the quality of the file, also for markers. progress: called with the current step and
    its fraction done.

    Raises InputError with file and key.
    """
    file = path_of(path)
    top = Table(_parse(file), str(file), "", TOP)
    table = top.table("camera", CAMERA)
    keyframes = read_keyframes(table, ("time", *CAMERA_POSE), lambda frame: _camera_pose(frame)[0])
    camera = (
        _camera(table, None if keyframes is None else np.asarray(keyframes.poses[0]))
        if "camera" in top
        else None
    )
    render = top.table("render", RENDER)
    if "background" in top and "background" in render:
        raise render.error("background", "and the table [background] exclude each other")
    quality = read_quality(top, render) if quality is None else quality
    marker_quality = Quality.of(quality).marker
    tables = top.tables("splats", SPLATS)
    on_disk = [table for table in tables if table.text("file").lower().endswith(SUFFIX)]
    load = cache(lambda name: load_splats(file.parent / name, progress))
    splats, markers, total = [], [], 0
    for splat_table in tables:
        if splat_table not in on_disk:
            splats.append(_splats(splat_table, load))
            total = _checked_total(file, total, splats[-1][0])
    for marker_table in top.tables("markers", MARKERS):
        markers.append(_marker(marker_table, file.parent, marker_quality, progress))
        total = _checked_total(file, total, markers[-1].marker.cloud)
    return dict(
        clouds=tuple(cloud for cloud, _ in splats),
        stores=tuple(_store(table, file.parent) for table in on_disk),
        camera=camera,
        markers=tuple(markers),
        background=read_background(top, file.parent) or render.numbers("background", 3, (0.0, 0.0, 0.0)),
        outputs=render.texts("outputs", ("rgb",)),
        quality=quality,
        device=render.text("device", None),
        shutter=read_shutter(table),
        camera_motion=keyframes,
        sensor=read_part(top, "sensor", Sensor),
        fog=read_part(top, "fog", Fog),
        lights=read_lights(top),
        cloud_motions={i: motion for i, (_, motion) in enumerate(splats) if motion is not None},
    )


def _parse(file: Path) -> dict:
    content = read_input(file, MAX_BYTES)
    try:
        text = content.decode("utf-8-sig")  # Windows editors add a byte-order mark
        if any(match["long"] for match in _LONG_KEY.finditer(text)):
            raise InputError(
                f"{file} is not a scene file: a dotted key has more than {MAX_PARTS} parts; scene files have "
                "at most three"
            )
        return tomllib.loads(text)
    except UnicodeDecodeError:
        raise InputError(
            f"{file} is not a scene file: it is not text in UTF-8; load_splats reads splats"
        ) from None
    except RecursionError:
        raise InputError(
            f"{file} is not a scene file: its lists are nested too deeply; docs/scene-files.md has the format"
        ) from None
    except InputError:
        raise
    except ValueError as error:  # TOMLDecodeError, or int() of a number of thousands of digits
        raise InputError(f"{file} is not a scene file in TOML: {error}; correct this line") from None


def _camera(table: Table, first: np.ndarray | None) -> Camera:
    """Camera of a table. first: pose of the first keyframe; None for a fixed camera."""
    width, height = table.whole("width"), table.whole("height")
    near, far = table.number("near", 0.01), table.number("far", math.inf, infinite=True)
    lens = read_lens(table)
    fx, fy = read_focal_lengths(table, width, height, lens)
    cx, cy = table.number("cx", width / 2), table.number("cy", height / 2)
    if first is None:
        pose, position = _camera_pose(table)
    else:
        for key in CAMERA_POSE:
            if key in table:
                raise table.error(key, "and motion exclude each other; give the pose in the keyframes")
        pose, position = first, None
    with table.at():
        return Camera.pinhole(width, height, fx, fy, cx, cy, pose, near, far, position, lens)


def _camera_pose(table: Table):
    """world_to_camera (4, 4), and the position if given."""
    if "world_to_camera" in table:
        for key in ("position", "look_at", "up"):
            if key in table:
                raise table.error(key, "and world_to_camera exclude each other")
        return np.array(table.matrix("world_to_camera")), None
    if "position" not in table:
        raise table.error("position", "is missing (position and look_at, or world_to_camera)")
    position, look_at = table.numbers("position", 3), table.numbers("look_at", 3)
    with table.at("look_at"):
        return look_at_matrix(position, look_at, table.numbers("up", 3, (0.0, -1.0, 0.0))), position


def _pose(table: Table, scale: float = 1.0):
    position, quaternion = (
        table.numbers("position", 3, (0.0,) * 3),
        table.numbers("quaternion", 4, (1.0, 0, 0, 0)),
    )
    with table.at("quaternion"):
        return rigid_matrix(position, quaternion, scale)


def _store(table: Table, folder: Path) -> Store:
    for key in SPLATS[1:]:
        if key in table:
            raise table.error(key, "cannot be used with a store; use `fidsplat store place`")
    with table.at("file"):
        return Store(folder / table.text("file"))


def _checked_total(file: Path, total: int, cloud: SplatCloud) -> int:
    """Add the bytes of a cloud to a total; raise InputError above the limit, as a small scene file can repeat
    one splat file."""
    arrays = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh, cloud.colors)
    total += sum(array.nbytes for array in arrays if array is not None)
    check_total(f"the splats of {file}", total, "build a store of them (`fidsplat store build`)")
    return total


def _splats(table: Table, load: Callable[[str], SplatCloud]) -> tuple[SplatCloud, Trajectory | None]:
    """Splats of a [[splats]] table at their pose, and their motion relative to it."""
    name, scale = table.text("file"), table.number("scale", 1.0)
    if not scale > 0:
        raise table.error("scale", f"must be above 0, got {scale!r}")
    pose, motion = _pose(table, scale), read_keyframes(table, POSE, _pose)
    if motion is not None:
        motion = Trajectory(motion.times, motion.poses @ np.linalg.inv(_pose(table)))
    with table.at("file"):
        cloud = load(name)
        moved = any(key in table for key in ("position", "quaternion", "scale"))
        return (cloud.transformed(pose) if moved else cloud), motion


def _shape(table: Table) -> SheetShape:
    """Shape of a marker from the table `shape`."""
    names = dict.fromkeys(name for kind in SHAPES.values() for name in names_of(kind))
    kind, shape_table = table.table("shape", ("kind", *names)).of_kind(SHAPES)
    with shape_table.at():
        return kind(**shape_table.values(kind))


def _marker(table: Table, folder: Path, quality: MarkerQuality, progress: Progress | None) -> PlacedMarker:
    spec, size = table.text("spec"), table.number("size")
    if not size > 0:
        raise table.error("size", f"must be above 0 metres, got {size!r}")
    pose, motion = _pose(table), read_keyframes(table, POSE, _pose)
    quiet_zone, max_splats = table.whole("quiet_zone", None), table.whole("max_splats", None)
    settings, light = table.values(MarkerQuality), read_lighting(table)
    if quiet_zone is not None and quiet_zone < 0:
        raise table.error("quiet_zone", f"must be 0 or more modules, got {quiet_zone}")
    from fidsplat.markers import marker, with_file  # lazy: heavy imports

    limit = {} if max_splats is None else {"max_splats": max_splats}
    limit |= {name: table.numbers(name, 3) for name in ("black", "white") if name in table}
    limit |= {name: table.text(name) for name in ("shape", "wear") if table.is_text(name)}
    if "shape" in table and "shape" not in limit:
        limit["shape"] = _shape(table)
    if "wear" in table and "wear" not in limit:
        own_wear = table.table("wear", names_of(Wear))
        with own_wear.at():
            limit["wear"] = Wear(**own_wear.values(Wear))
    known = {"quiet_zone": quiet_zone, "quality": quality, "progress": progress, **limit}
    with table.at():
        spec = with_file(spec, lambda name: str(folder / name))
        built = marker(spec, size, **known, **settings)
        bundle = table.text("bundle", None)
        return PlacedMarker(built, pose, motion=motion, bundle=bundle, light=light)
