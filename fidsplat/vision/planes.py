"""The planes of a frame as files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fidsplat.files import atomic_write
from fidsplat.vision.images import write_png
from fidsplat.vision.paint import (
    count_picture,
    depth_millimetres,
    depth_picture,
    label_picture,
    normal_picture,
)


def save_plane(
    name: str, plane: np.ndarray, name_of: Callable[[str, str], Path], bits: int | None = None
) -> list[Path]:
    """Write one plane and return the files.

    Args:
        name: "rgb", "depth", ...
        plane: (h, w) or (h, w, 3).
        bits: 16 writes rgb as a 16-bit PNG.
        name_of: gives the file for a plane's name and a suffix such as ".png" or "-turbo.png".
    """
    if name.startswith(("depth", "distance")):
        return [
            _write_array(name_of(name, ".npy"), plane),
            write_png(name_of(name, ".png"), depth_millimetres(plane)),
            write_png(name_of(name, "-turbo.png"), depth_picture(plane)),
        ]
    if name in ("label", "splat_id", "blended"):
        picture = count_picture if name == "blended" else label_picture
        return [
            _write_array(name_of(name, ".npy"), plane),
            write_png(name_of(name, ".png"), picture(plane)),
        ]
    if name == "rgb" and bits == 16:
        deep = np.rint(np.clip(np.nan_to_num(plane, nan=0.0), 0, 1) * 65535).astype(np.uint16)
        return [write_png(name_of(name, ".png"), deep)]
    is_normal = name in ("normal", "normal_world")
    return [write_png(name_of(name, ".png"), normal_picture(plane) if is_normal else plane)]


def _write_array(path: Path, array: np.ndarray) -> Path:
    with atomic_write(path) as stream:
        np.save(stream, array)
    return path
