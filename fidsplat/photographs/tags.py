"""Tags in photographs: detection, boxes around them, and the inks of their print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.images.files import read_image
from fidsplat.markers import Marker, marker
from fidsplat.markers.kinds import detectors
from fidsplat.photographs.adjustment import TagView
from fidsplat.scenes.parts import PlacedMarker
from fidsplat.util.errors import InputError
from fidsplat.util.progress import Progress
from fidsplat.vision.detect import detect
from fidsplat.vision.readback import content_of, families_of

THICK = 0.15
"""half the thickness of a tag's box, as a fraction of its size"""
_MIN_MODULE = 3.0
"""pixels: smallest module whose colour is measured"""
_MIN_CONTRAST = 0.1


def parse_tags(texts: Sequence[str]) -> dict[str, Marker]:
    """Markers of `SPEC=METRES`, by their specs. Raises InputError."""
    tags: dict[str, Marker] = {}
    for text in texts:
        spec, _, size = text.rpartition("=")
        try:
            metres = float(size)
        except ValueError:
            metres = 0.0
        if not (spec and 0.001 <= metres <= 100):
            raise InputError(
                "--tag must be a marker spec and the edge of its black square, 0.001 to 100 metres, got "
                f"{text!r}; write for example apriltag:36h11:5=0.16"
            )
        printed = marker(spec, metres)
        kinds = "apriltag", "aruco", "qr", *detectors()
        if printed.kind not in kinds:
            raise InputError(
                f"--tag must be of a detected kind ({', '.join(kinds)}), got {spec}; print another"
            )
        other = same_tag(tags, printed)
        if other is not None:
            raise InputError(
                f"each tag must be given once, got {other.size:g} and {printed.size:g} m for {printed.spec}; "
                "measure the edge of its black square and omit the other"
            )
        tags[printed.spec] = printed
    return tags


def same_tag(tags: Mapping[str, Marker], tag: Marker) -> Marker | None:
    """The tag with the same content as a marker, also if its spec is spelled differently; None without
    one."""
    return next((each for each in tags.values() if content_of(each) == content_of(tag)), None)


def detect_tags(
    folder: Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    tags: Mapping[str, Marker],
    progress: Progress,
) -> list[TagView]:
    """Detect tags in photographs; corners in pixels of the camera without its lens.

    Raises InputError for a tag that occurs twice in a photograph.
    """
    families, qr = families_of(tags.values()), any(printed.kind == "qr" for printed in tags.values())
    views: list[TagView] = []
    for number, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        progress("tags", number / len(names))
        detections = detect(read_image(folder / name), families, qr)
        for spec, printed in tags.items():
            matches = [code for code in detections if content_of(code) == content_of(printed)]
            if len(matches) > 1:
                raise InputError(
                    f"{spec} must occur once in the scene, got {len(matches)} in {name}; remove copies, or "
                    "print tags with other ids"
                )
            for code in matches:
                rays = camera.rays(code.corners)
                corners = rays[:, :2] / rays[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
                if np.isfinite(corners).all() and (rays[:, 2] > 0).all():
                    views.append(TagView(spec, number, corners))
    return views


def box_of(tag: PlacedMarker) -> np.ndarray:
    """Matrix (4, 4) from the cube [-1, 1]^3 to a box around a tag, in which splats represent its print."""
    h, w = np.array(tag.marker.grid.shape) * tag.marker.module / 2
    return tag.pose @ np.diag([w, h, THICK * tag.marker.size, 1.0])


def module_colors(
    placed: PlacedMarker, image: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray] | None:
    """Median colours (3,) of the dark and the light modules in a photograph (h, w, 3) uint8, display values;
    None if the modules are too small or too few are in the image."""
    printed = placed.marker
    rows, columns = np.indices(printed.bits.shape) + 0.5
    middle = np.array(printed.bits.shape) / 2
    flat = np.stack([columns - middle[1], rows - middle[0], 0 * rows], -1).reshape(-1, 3) * printed.module
    at = camera.project(flat @ placed.pose[:3, :3].T + placed.pose[:3, 3])
    with np.errstate(invalid="ignore"):
        inside = ((at >= 0) & (at < (camera.width, camera.height))).all(1)
    edges = np.linalg.norm(np.diff(at.reshape(*printed.bits.shape, 2), axis=1), axis=-1)
    if not inside.all() or edges.min() < _MIN_MODULE:
        return None
    values = image[at[:, 1].astype(int), at[:, 0].astype(int)] / 255.0
    dark, light = (np.median(values[printed.bits.ravel() == bit], axis=0) for bit in (1, 0))
    return (dark, light) if (light - dark).min() > _MIN_CONTRAST else None
