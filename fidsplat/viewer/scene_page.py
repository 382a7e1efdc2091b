"""Self-contained HTML page of a scene, rendered by the PlayCanvas Engine."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.foreign import OPENGL_AXES
from fidsplat.formats.ply import save_ply
from fidsplat.formats.sog import save_sog
from fidsplat.scenes.scene import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of, read_input, user_cache, write_file

ENGINE = "FIDSPLAT_PLAYCANVAS"
"""environment variable with the path of a playcanvas.min.js that replaces the downloaded one"""
VERSION = "2.23.3"
_FILES = {
    "build/playcanvas.min.js": "fea87830de8d74b71fe3ef6c7ce1e04a5aa60c5e9976da06b866774ea9ae9711",
    "LICENSE": "42fa51ddd556be151a29f381fb97ee975825dcc454e805ea3ea9c079cca04d34",
}
"""files of the npm package and their SHA-256"""
MAX_SPLATS = 8_000_000
"""maximum number of splats of a page, as browsers limit a text to about half a gigabyte"""
_GLTF_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])


def save_page(scene: Scene, path: str | os.PathLike[str], title: str = "fidsplat") -> None:
    """Write a scene as one HTML file that renders it offline, with WebGL 2, from its camera.

    The page omits the scene's lens, shutter, sensor, fog and the light on markers. Markers and boxes are
    Gaussians, and moving objects have their pose at time 0.

    Raises InputError for a scene without a camera or splats, a failed download of the engine, or a file that
    cannot be written.
    """
    if scene.camera is None:
        raise InputError("a scene for a page must have a camera, got none; add a [camera] table")
    count = sum(map(len, (*scene.stores, *scene.clouds)))
    if count > MAX_SPLATS:
        raise InputError(
            f"a page must have at most {MAX_SPLATS:,} splats, got {count:,}; write streamed SOG "
            "(lod-meta.json) of a store"
        )
    parts = [store.cloud() for store in scene.stores] + list(scene.clouds)
    marked = [placed.marker.gaussians.transformed(placed.pose) for placed in scene.markers]
    files = {}
    with tempfile.TemporaryDirectory() as folder:
        # markers are not compressed: scales of 8 bits would cause seams
        for name, clouds, save in (("scene.sog", parts, save_sog), ("markers.ply", marked, save_ply)):
            if clouds := [cloud for cloud in clouds if len(cloud)]:
                save(SplatCloud.concatenate(clouds), Path(folder, name))
                files[name] = base64.b64encode(Path(folder, name).read_bytes()).decode("ascii")
    if not files:
        raise InputError("a scene for a page must have splats or markers, got none")
    means = np.concatenate([cloud.world_means() for cloud in parts + marked])
    engine, licence = engine_files()
    clear = scene.background if isinstance(scene.background, tuple) else (0.0, 0.0, 0.0)
    view = _view(means, scene.camera) | {
        "clear": [float(value) for value in clear] + [1.0],
        "splats": files,
        "note": f"{title}: drag to turn, right button to move, wheel for the distance",
    }
    color = "rgb({},{},{})".format(*(round(255 * min(max(float(value), 0.0), 1.0)) for value in clear))
    page = Template(Path(__file__).with_name("scene_page.html").read_text("utf-8")).substitute(
        title=html.escape(title),
        licence=licence.replace("--", "- -"),
        background=color,
        engine=_in_script(engine),
        view=_in_script(json.dumps(view)),
    )
    write_file(path, page)


def _in_script(text: str) -> str:
    """Escape text for a script element, which the text must not end."""
    return text.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _view(means: np.ndarray, camera: Camera) -> dict[str, Any]:
    """Pose, field of view and clipping of a camera, in PlayCanvas' axes."""
    world_to_camera = np.asarray(camera.world_to_camera, np.float64)
    pose = _GLTF_AXES @ np.linalg.inv(world_to_camera) @ OPENGL_AXES
    depths = means @ world_to_camera[2, :3] + world_to_camera[2, 3]
    front = depths[depths > 0]
    middle = float(np.median(front)) if len(front) else 1.0
    far = 10 * float(np.abs(depths).max(initial=middle)) + middle
    return {
        "pose": pose.T.ravel().tolist(),
        "fov": float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))),
        "distance": middle,
        "near": max(middle / 1000, far * 1e-6),
        "far": far,
    }


def engine_files(run: Callable[[list[str]], str] | None = None) -> tuple[str, str]:
    """Source and licence text of the PlayCanvas Engine, from the user's cache, or from npm on first use.

    Raises InputError if npm is missing or the files differ from their checksums.
    """
    if (own_engine := os.environ.get(ENGINE)) is not None:
        engine = path_of(own_engine)
        licence = engine.with_name("LICENSE")
        text = read_input(licence).decode() if licence.is_file() else "MIT, https://playcanvas.com"
        return read_input(engine).decode("utf-8", "replace"), text
    folder = user_cache() / "fidsplat" / f"playcanvas-{VERSION}"
    if not all((folder / Path(name).name).is_file() for name in _FILES):
        _obtain(folder, run or _npm)
    engine, licence = (_checked(folder / Path(name).name, name).decode() for name in _FILES)
    return engine, licence


def _checked(file: Path, name: str) -> bytes:
    data = read_input(file)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != _FILES[name]:
        raise InputError(f"{file} must have the SHA-256 {_FILES[name]}, got {sha256}; remove it")
    return data


def _obtain(folder: Path, run: Callable[[list[str]], str]) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        words = ["pack", "--silent", "--pack-destination", temporary, f"playcanvas@{VERSION}"]
        archive = Path(temporary, run(words).strip())
        folder.mkdir(parents=True, exist_ok=True)
        with tarfile.open(archive) as members:
            for name, expected in _FILES.items():
                member = members.extractfile(f"package/{name}")
                data = b"" if member is None else member.read()
                sha256 = hashlib.sha256(data).hexdigest()
                if sha256 != expected:
                    raise InputError(
                        f"{name} of playcanvas must have the SHA-256 {expected}, got {sha256}; download "
                        "it again"
                    )
                write_file(folder / Path(name).name, data)


def _npm(words: list[str]) -> str:
    program = shutil.which("npm")
    if program is None:
        raise InputError(
            f"an HTML page needs the PlayCanvas Engine {VERSION}, which npm downloads once; install npm, "
            f"or set {ENGINE} to the path of its playcanvas.min.js"
        )
    done = interrupts.run([program, *words])
    if done.returncode != 0:
        raise InputError(
            f"npm cannot download playcanvas {VERSION}: {done.stderr.strip()[-300:]}; check the network, or "
            f"set {ENGINE} to the path of its playcanvas.min.js"
        )
    return done.stdout
