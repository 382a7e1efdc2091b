"""Cameras of COLMAP models and transforms.json, by the names of their images."""

from __future__ import annotations

import os

from fidsplat.cameras import Camera
from fidsplat.formats.colmap_read import has_colmap, load_colmap
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, path_of, read_text

_MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0")
_TRANSFORMS = ("transforms.json", "transforms_train.json")


def load_cameras(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Cameras by the names of their images, from a COLMAP model (its folder, or one that contains
    `sparse/0`) or nerfstudio's transforms.json (the file or its folder).

    Raises:
        InputError: neither of them, a damaged file, or an unsupported lens.
    """
    file = path_of(path)
    for place in (file / name for name in _MODELS):
        if has_colmap(place):
            model = load_colmap(place)
            return dict(zip(model.names, model.cameras, strict=True))
    found = [one for one in (file, *(file / name for name in _TRANSFORMS)) if one.is_file()]
    if not found:
        raise InputError(
            "path must be a transforms.json, or a folder with one or with a COLMAP model (cameras.bin), "
            f"got {file}"
        )
    try:
        transforms = from_json(read_text(found[0]))
        names = [str(frame["file_path"]) for frame in transforms["frames"]]
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"cannot read {found[0]} as a transforms.json: {error}") from None
    cameras = {}
    for number, name in enumerate(names):
        try:
            cameras[name] = Camera.from_nerfstudio(transforms, number)
        except InputError as error:
            raise InputError(f"{found[0]}: {name}: {error}") from error
    return cameras
