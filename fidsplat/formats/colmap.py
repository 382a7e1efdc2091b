"""Writing of COLMAP models, text and binary: cameras, images and points3D.

Format: COLMAP's documentation, "Output format". Poses are world to camera with OpenCV's axes, as in fidsplat.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.util.errors import InputError
from fidsplat.util.files import writable_folder, write_file

_PINHOLE = 1  # id of the camera model PINHOLE: fx, fy, cx, cy
_HEADS = {
    "cameras": "# Camera list with one line of data per camera:\n"
    "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n",
    "images": "# Image list with two lines of data per image:\n"
    "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n",
    "points3D": "# 3D point list with one line of data per point:\n"
    "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
}


def save_colmap(
    folder: str | Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    points: np.ndarray,
    colors: np.ndarray,
) -> list[Path]:
    """Write a COLMAP model: cameras, images and points3D, each as .txt and .bin.

    Args:
        folder: created if missing.
        names: n file names of the images, without line breaks or blanks.
        cameras: n cameras. Equal intrinsics become one COLMAP camera (model PINHOLE).
        points: (m, 3) float64 metres; written without tracks.
        colors: (m, 3) uint8.

    Raises InputError for a folder that cannot be written or an invalid name.
    """
    for name in names:
        if not name or name.split() != [name]:
            raise InputError(f"the name of a COLMAP image must have no blanks, got {name!r}; rename it")
    if len(names) != len(cameras) or len(points) != len(colors):
        raise InputError(
            f"a COLMAP model must have a name for each camera and a colour for each point, got {len(names)} "
            f"names, {len(cameras)} cameras, {len(colors)} colours, {len(points)} points"
        )
    lenses: dict[tuple, int] = {}
    used = [lenses.setdefault((c.width, c.height, c.fx, c.fy, c.cx, c.cy), len(lenses) + 1) for c in cameras]
    poses = [(*matrix_to_quaternion(c.world_to_camera[:3, :3]), *c.world_to_camera[:3, 3]) for c in cameras]
    target = writable_folder(folder)
    texts = {
        "cameras": _lines((number, "PINHOLE", *lens) for lens, number in lenses.items()),
        "images": _lines(
            (i, *pose, lens, name, "\n")
            for i, (pose, lens, name) in enumerate(zip(poses, used, names, strict=True), 1)
        ),
        "points3D": _lines(
            (i, *place, *color, 0.0) for i, (place, color) in enumerate(zip(points, colors, strict=True), 1)
        ),
    }
    binaries = {
        "cameras": _count(lenses)
        + b"".join(struct.pack("<iiQQ4d", i, _PINHOLE, *lens) for lens, i in lenses.items()),
        "images": _count(names)
        + b"".join(
            struct.pack("<i7di", i, *pose, lens) + name.encode() + b"\0" + struct.pack("<Q", 0)
            for i, (pose, lens, name) in enumerate(zip(poses, used, names, strict=True), 1)
        ),
        "points3D": _count(points)
        + b"".join(
            struct.pack("<Q3d3BdQ", i, *place, *color, 0.0, 0)
            for i, (place, color) in enumerate(zip(points, colors, strict=True), 1)
        ),
    }
    files = []
    for name, head in _HEADS.items():
        for suffix, data in ((".txt", (head + texts[name]).encode()), (".bin", binaries[name])):
            files.append(target / f"{name}{suffix}")
            write_file(files[-1], data)
    return files


def _count(items) -> bytes:
    return struct.pack("<Q", len(items))


def _lines(rows) -> str:
    # repr of a float is the shortest text that reads back as the same number
    return "".join(
        " ".join(repr(float(v)) if isinstance(v, float) else str(v) for v in row).replace(" \n", "\n") + "\n"
        for row in rows
    )
