"""Writer of scene files in TOML, and of the PLY files that they name."""

import json
import os
from pathlib import Path

import numpy as np

from fidsplat.capture.quality import Quality
from fidsplat.formats import save_ply
from fidsplat.markers import with_file
from fidsplat.markers.printing import MAX_SPLATS
from fidsplat.scenes.camera import keyframe_tables, lens_table, shutter_table
from fidsplat.scenes.environment import environment_tables, marker_settings, quality_tables
from fidsplat.scenes.lights import Lighting, light_tables, lighting_value
from fidsplat.scenes.parts import PlacedMarker, SceneParts
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.util.arguments import changes_of
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of, write_file


def write_scene(scene: SceneParts, path: str | os.PathLike[str]) -> None:
    """Write STEM-splats-I.ply for each cloud, then the scene file, which never names a missing file.

    Raises InputError if a file cannot be written, or a marker cannot be expressed in a scene file.
    """
    file = path_of(path)
    render, qualities = _render(scene)
    environment = environment_tables(scene, file.parent)
    markers = [_marker(placed, file.parent, scene.quality) for placed in scene.markers]
    motions = {
        i: {"motion": keyframe_tables(motion, f"cloud {i}")} for i, motion in scene.cloud_motions.items()
    }
    splats = []
    for i, cloud in enumerate(scene.clouds):
        name = f"{file.stem}-splats-{i}.ply"
        save_ply(cloud, file.parent / name)
        splats.append({"file": name, **motions.get(i, {})})
    for store in scene.stores:
        splats.append({"file": os.path.relpath(store.path.resolve(), file.parent.resolve())})
    parts = [] if scene.camera is None else [_table("[camera]", _camera(scene))]
    lens = None if scene.camera is None else lens_table(scene.camera)
    parts += [] if lens is None else [_table(f"[camera.{lens[0]}]", lens[1])]
    if scene.shutter is not None:
        parts.append(_table("[camera.shutter]", shutter_table(scene.shutter)))
    if scene.camera_motion is not None:
        frames = keyframe_tables(scene.camera_motion, "the camera", camera=True)
        parts += [_table("[[camera.motion]]", frame) for frame in frames]
    parts += [_table("[[splats]]", table) for table in splats]
    parts += [_table("[[markers]]", table) for table in markers]
    parts += [_table("[[lights]]", table) for table in light_tables(scene.lights)]
    parts += [_table(f"[{name}]", table) for name, table in environment.items()]
    parts.append(_table("[render]", render))
    parts += [_table(f"[{name}]", table) for name, table in qualities.items()]
    try:
        content = "\n".join(parts).encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(
            f"cannot write {file}: a text in the scene is not Unicode ({error.reason})"
        ) from error
    write_file(file, content)


def marker_block(placed: PlacedMarker, folder: Path, quality: Quality | str | None = None) -> str:
    """The [[markers]] table of a marker for a scene file in a folder. quality: quality of the scene.

    Raises InputError if the marker cannot be expressed in a scene file.
    """
    return _table("[[markers]]", _marker(placed, folder, quality))


def _camera(scene: SceneParts) -> dict:
    camera = scene.camera
    assert camera is not None
    keys = ("width", "height", "fx", "fy", "cx", "cy", "near", "far")
    table = {key: getattr(camera, key) for key in keys}
    # the poses of a moving camera are in the keyframes
    return table if scene.camera_motion else table | {"world_to_camera": camera.world_to_camera.tolist()}


def _marker(placed: PlacedMarker, folder: Path, quality: Quality | str | None) -> dict:
    marker = placed.marker
    spec = with_file(marker.spec, lambda name: os.path.relpath(name, folder))
    motion = {} if placed.motion is None else {"motion": keyframe_tables(placed.motion, marker.spec)}
    limit = {} if marker.max_splats == MAX_SPLATS else {"max_splats": marker.max_splats}
    inks = {} if marker.inks is None else dict(zip(("black", "white"), map(list, marker.inks), strict=True))
    bundle = {} if placed.bundle is None else {"bundle": placed.bundle}
    return {
        "spec": spec,
        "size": float(marker.size),
        "position": placed.pose[:3, 3].tolist(),
        "quaternion": matrix_to_quaternion(placed.pose[:3, :3]).tolist(),
        **marker_settings(marker.quality, quality),
        "quiet_zone": int(marker.quiet_zone),
        **limit,
        **inks,
        **({} if marker.shape is None else {"shape": {"kind": marker.shape.kind} | changes_of(marker.shape)}),
        **({} if marker.wear is None else {"wear": changes_of(marker.wear)}),
        **bundle,
        **lighting_value(Lighting.of(placed.light)),
        **motion,
    }


def _render(scene: SceneParts) -> tuple[dict, dict[str, dict]]:
    table: dict = {"outputs": list(scene.outputs)}
    if isinstance(scene.background, tuple):
        table["background"] = list(scene.background)
    keys, tables = quality_tables(scene.quality)
    table |= keys
    if scene.device is not None:
        table["device"] = scene.device
    return table, tables


def _table(head: str, values: dict) -> str:
    return "\n".join([head, *(f"{key} = {_value(value)}" for key, value in values.items()), ""])


def _value(value) -> str:
    if isinstance(value, str):  # the escapes of JSON are those of TOML, except for DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_value(part)}" for key, part in value.items()) + "}"
    plain = value.item() if isinstance(value, np.generic) else value
    return repr(plain)  # Python and TOML write int, float and inf alike
