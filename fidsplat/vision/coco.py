"""Writer of ground truth as COCO annotations (https://cocodataset.org/#format-data)."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from fidsplat.util.arguments import instance, text
from fidsplat.util.errors import InputError
from fidsplat.util.files import ordinary_file, write_json
from fidsplat.vision.truth import GroupTruth, MarkerTruth, Truth
from fidsplat.vision.visible import outline

CORNERS = ("top_left", "top_right", "bottom_right", "bottom_left")


class CocoAnnotations:
    """Annotations of many images: box, mask and corners (as keypoints) of each visible marker, box and mask
    of each named group of splats.

    A category is the spec of a marker, e.g. `apriltag:36h11:5`, or the name of a group. In addition to COCO's
    fields an annotation of a marker has `camera_from_marker`, `visible`, `distance_m` and `tilt_deg`.

    Args:
        groups: {label: name} of groups of splats to annotate.
    """

    def __init__(self, groups: Mapping[int, str] | None = None) -> None:
        self._groups = {} if groups is None else dict(groups)
        self._categories: dict[str, dict[str, Any]] = {}
        self._images: dict[str, dict[str, Any]] = {}
        self._annotations: list[dict[str, Any]] = []

    def add(self, file_name: str, truth: Truth) -> None:
        """Annotate an image. file_name: its name in the annotations.

        Raises:
            InputError: an image that is already annotated.
        """
        text("file_name", file_name)
        instance("truth", truth, Truth, "what truth_of returns")
        if file_name in self._images:
            raise InputError(f"file_name must be new, got {file_name!r} again; use another name")
        camera = truth.camera
        image = {"id": len(self._images) + 1, "file_name": file_name}
        self._images[file_name] = image | {"width": camera.width, "height": camera.height}
        for marker in truth.markers:
            if marker.visible > 0:
                self._keep(image["id"], marker.placed.marker.spec, self._of_marker(marker, truth), True)
        for label, name in self._groups.items():
            if label in truth.groups:
                self._keep(image["id"], name, _of_group(truth.groups[label]), False)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the annotations as JSON. Raises InputError for a file that cannot be written."""
        content = {
            "info": {"description": "rendered by fidsplat"},
            "images": list(self._images.values()),
            "annotations": self._annotations,
            "categories": list(self._categories.values()),
        }
        write_json(ordinary_file(path), content)

    def _keep(self, image: Any, name: str, annotation: dict[str, Any], marker: bool) -> None:
        if name not in self._categories:
            category: dict[str, Any] = {"id": len(self._categories) + 1, "name": name}
            category["supercategory"] = "marker" if marker else "group"
            if marker:
                category |= {"keypoints": list(CORNERS), "skeleton": [[1, 2], [2, 3], [3, 4], [4, 1]]}
            self._categories[name] = category
        number = {"id": len(self._annotations) + 1, "image_id": image}
        self._annotations.append(number | {"category_id": self._categories[name]["id"]} | annotation)

    def _of_marker(self, marker: MarkerTruth, truth: Truth) -> dict[str, Any]:
        group = truth.groups.get(marker.placed.label)
        if group is not None:
            annotation = _of_group(group)
        else:  # an image without labels: its outline
            assert marker.box is not None
            x0, y0, x1, y1 = marker.box
            shape = outline(marker.placed, truth.camera)
            annotation = {
                "segmentation": [polygon.ravel().tolist() for polygon in shape.polygons],
                "bbox": [x0, y0, x1 - x0, y1 - y0],
                "area": shape.visible_area,
                "iscrowd": 0,
            }
        points, width, height = marker.corners, truth.camera.width, truth.camera.height
        inside = [bool(0 <= x < width and 0 <= y < height) for x, y in points]
        keypoints = [
            float(number)
            for (x, y), visible in zip(points, inside, strict=True)
            for number in ((x, y, 2) if visible else (0, 0, 0))
        ]
        return annotation | {
            "keypoints": keypoints,
            "num_keypoints": sum(inside),
            "camera_from_marker": marker.truth.tolist(),
            "visible": marker.visible,
            "distance_m": marker.distance,
            "tilt_deg": math.degrees(marker.tilt),
        }


def _of_group(group: GroupTruth) -> dict[str, Any]:
    x0, y0, x1, y1 = map(int, group.box)
    counts = run_lengths(group.labels[y0:y1, x0:x1] == group.label, (x0, y0), group.labels.shape)
    return {
        "segmentation": {"counts": counts, "size": list(group.labels.shape)},
        "bbox": [float(x) for x in (x0, y0, x1 - x0, y1 - y0)],
        "area": float(sum(counts[1::2])),
        "iscrowd": 0,
    }


def run_lengths(mask: np.ndarray, at: tuple[int, int] = (0, 0), shape: Any = None) -> list[int]:
    """Encode a mask (h, w) bool as COCO's uncompressed run lengths: column by column, False first.

    at: x and y of the mask in an image of the shape (height, width), which is False elsewhere.
    """
    height, width = mask.shape if shape is None else shape
    columns = np.pad(mask.T, ((0, 0), (1, 1)))
    column, row = np.nonzero(columns[:, 1:] != columns[:, :-1])
    edges, counts = np.unique((at[0] + column) * height + at[1] + row, return_counts=True)
    edges = edges[counts == 1]  # not where a run continues in the next column
    lengths = np.diff(edges, prepend=0).tolist()
    rest = height * width - int(edges[-1] if len(edges) else 0)
    return [*lengths, rest] if rest else lengths
