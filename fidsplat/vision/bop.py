"""Writer of images and ground truth in the format of the BOP challenge
(https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.foreign import opencv_matrix
from fidsplat.images.files import write_png
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, read_text, writable_folder, write_json
from fidsplat.vision.truth import Box, MarkerTruth, Truth
from fidsplat.vision.visible import POINTS, outline

DEPTH_SCALE = 0.1
"""millimetres of a depth step; 16 bits have a range of 6.5 m"""


class BopScene:
    """One scene of a BOP data set: rgb, depth and masks as images, intrinsics and poses as JSON. An object
    is a marker by spec, extents and shape; its obj_id is its label, or the next free number where the data
    set has this label for another marker.

    `save`, or the end of a `with` block, writes the JSON files.

    Args:
        folder: e.g. `dataset/train/000000`. `models/models_info.json`, which the scenes of a data set share,
            is written two folders above.

    Raises:
        InputError: a folder that cannot be written, or that already has a scene.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._folder = writable_folder(folder)
        if (self._folder / "scene_gt.json").exists():
            raise InputError(f"the folder must not have a scene yet, got {self._folder}; give another one")
        for name in ("rgb", "depth", "mask_visib"):
            (self._folder / name).mkdir(exist_ok=True)
        self._cameras: dict[str, Any] = {}
        self._poses: dict[str, Any] = {}
        self._info: dict[str, Any] = {}
        self._models: dict[str, Any] = {}

    def __enter__(self) -> BopScene:
        return self

    def __exit__(self, kind: type | None, *_: Any) -> None:
        if kind is None:
            self.save()

    def add(self, frame: Mapping[str, np.ndarray], truth: Truth) -> None:
        """Write a frame: `rgb`, and `depth` and `label` if present. Depths that exceed 16 bits become 0
        (unknown).

        Raises:
            InputError: a camera with a lens, which BOP does not support.
        """
        camera = truth.camera
        check_bop_camera(camera)
        number = len(self._cameras)
        name = f"{number:06d}"
        write_png(self._folder / "rgb" / f"{name}.png", frame["rgb"])
        if "depth" in frame:
            steps = np.rint(frame["depth"] * (1000 / DEPTH_SCALE))
            write_png(
                self._folder / "depth" / f"{name}.png", np.where(steps < 65536, steps, 0).astype(np.uint16)
            )
        self._cameras[str(number)] = {
            "cam_K": opencv_matrix(camera).ravel().tolist(),
            "cam_R_w2c": camera.world_to_camera[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * camera.world_to_camera[:3, 3]).tolist(),
            "depth_scale": DEPTH_SCALE,
        }
        self._poses[str(number)], self._info[str(number)] = [], []
        for i, marker in enumerate(truth.markers):
            label = marker.placed.label
            self._poses[str(number)].append(
                {
                    "obj_id": _add_model(self._models, label, _model(marker)),
                    "cam_R_m2c": marker.truth[:3, :3].ravel().tolist(),
                    "cam_t_m2c": (1000 * marker.truth[:3, 3]).tolist(),
                }
            )
            group = truth.groups.get(label)
            mask = np.zeros((camera.height, camera.width), bool) if group is None else group.mask
            write_png(self._folder / "mask_visib" / f"{name}_{i:06d}.png", mask)
            self._info[str(number)].append(_visibility(marker, truth, mask))

    def save(self) -> None:
        """Write the JSON files.

        Raises:
            InputError: a file that cannot be written.
        """
        models = writable_folder(self._folder.resolve().parent.parent / "models") / "models_info.json"
        known = _known(models)
        ids = {int(key): _add_model(known, int(key), model) for key, model in self._models.items()}
        poses = {
            image: [pose | {"obj_id": ids[pose["obj_id"]]} for pose in each]
            for image, each in self._poses.items()
        }
        for name, content in (
            ("scene_camera.json", self._cameras),
            ("scene_gt.json", poses),
            ("scene_gt_info.json", self._info),
        ):
            _write(self._folder / name, content)
        _write(models, known)


def check_bop_camera(camera: Camera) -> None:
    """Raise InputError for a camera with a lens."""
    if camera.lens is not None:
        raise InputError(
            f"a BOP scene must have a pinhole camera without lens, got {camera.lens.kind}; render without "
            "one, or undistort"
        )


def _visibility(marker: MarkerTruth, truth: Truth, mask: np.ndarray) -> dict[str, Any]:
    polygon, group = outline(marker.placed, truth.camera), truth.groups.get(marker.placed.label)
    return {
        "bbox_obj": _box(polygon.box),
        "bbox_visib": _box(None if group is None else group.box),
        "px_count_all": round(polygon.area),
        "px_count_visib": int(mask.sum()),
        "visib_fract": marker.visible,
    }


def _box(box: Box | None) -> list[float]:
    """BOP's box: x, y, width, height; -1 for an empty box."""
    return [-1, -1, -1, -1] if box is None else [box[0], box[1], box[2] - box[0], box[3] - box[1]]


def _model(marker: MarkerTruth) -> dict[str, Any]:
    printed = marker.placed.marker
    across = np.linspace(-1, 1, POINTS) * np.abs(printed.flat_corners[:1].T)
    at = 1000 * printed.points(np.stack(np.meshgrid(*across), -1).reshape(-1, 2))
    low, high = at.min(0), at.max(0)
    names = "xyz"
    return {
        "spec": printed.spec,
        **({} if printed.shape is None else {"shape": repr(printed.shape)}),
        "diameter": float(np.linalg.norm(high - low)),
        **{f"min_{n}": float(v) for n, v in zip(names, low, strict=True)},
        **{f"size_{n}": float(v) for n, v in zip(names, high - low, strict=True)},
    }


def _add_model(models: dict[str, dict[str, Any]], preferred: int, model: dict[str, Any]) -> int:
    """Add a model to `models` under the preferred obj_id, or the next free one; returns its obj_id."""
    if models.get(str(preferred), model) != model:
        equal = (int(key) for key, other in models.items() if other == model)
        preferred = next(equal, 1 + max(map(int, models)))
    models[str(preferred)] = model
    return preferred


def _known(path: Path) -> dict[str, dict[str, Any]]:
    """Models in an existing models_info.json."""
    try:
        return from_json(read_text(path)) if path.exists() else {}
    except ValueError as error:
        raise InputError(f"cannot read {path}: {error}; give another folder") from None


def _write(path: os.PathLike[str], content: Any) -> None:
    write_json(path, content)
