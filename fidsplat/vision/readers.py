"""Off-the-shelf detectors with their defaults, for comparisons.

`detect` combines detectors and refines corners.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from itertools import product
from threading import local
from typing import Any

import cv2
import numpy as np
import zxingcpp

from fidsplat.images.apriltag3 import LAYOUTS
from fidsplat.images.tag_dictionaries import predefined
from fidsplat.util.errors import InputError
from fidsplat.vision.apriltag_library import read_tags
from fidsplat.vision.detect import QR_ONLY, corners_of

# scale factors of the image and additional factors of its height that are tried for zxing-cpp: all heights at
# the original size first, then at twice the size
UNFORESHORTEN = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
ENLARGE = (1.0, 2.0)
# minimum intersection over union with the code
MIN_OVERLAP = 0.5
_MARGIN = 16  # margin in pixels around the foreground
_of_thread = local()


@dataclass(frozen=True, eq=False)
class Target:
    """The code to detect in an image."""

    kind: str
    """"apriltag", "aruco" or "qr\""""
    family: str
    """tag family, e.g. "36h11"; ignored for QR codes"""
    id: int | None
    payload: str | None
    corners: np.ndarray
    """(4, 2) pixels, true corners of the code's outer edge"""


@dataclass(frozen=True)
class Attempt:
    """The result of one detector for one image."""

    found: bool
    """whether a quadrilateral overlaps the code (`MIN_OVERLAP`), decoded or not"""
    read: bool
    """whether exactly this id or text was decoded"""
    corners: np.ndarray | None = field(default=None, compare=False)
    """(4, 2) pixels of the decoded code, TL, TR, BR, BL as printed; None if it was not read"""


def _aruco(grey: np.ndarray, target: Target) -> Attempt:
    """OpenCV's aruco module with its defaults."""
    detector = cv2.aruco.ArucoDetector(predefined(target.kind, target.family))
    quads, ids, rejected = detector.detectMarkers(grey)
    # OpenCV counts from the centre of the first pixel
    every = [quad.reshape(4, 2) + 0.5 for quad in (*quads, *rejected)]
    numbers = [] if ids is None else ids.ravel()
    return attempt_of(zip(map(int, numbers), every, strict=False), target, every)


def _pupil(grey: np.ndarray, target: Target) -> Attempt:
    """The AprilTag library at full resolution. It reports only decoded tags."""
    tags = read_tags(grey, target.family)
    if target.family not in LAYOUTS:  # OpenCV prints the families of AprilTag 2 upside down
        tags = [(number, np.roll(corners, 2, axis=0)) for number, corners in tags]
    return attempt_of(tags, target)


def _locus(grey: np.ndarray, target: Target) -> Attempt:
    """locus-tag with its defaults. It reports only decoded tags."""
    detections = _locus_detector(target.family).detect(grey)
    return attempt_of(
        zip(detections.ids.tolist(), detections.corners.astype(np.float64), strict=True), target
    )


def _locus_detector(family: str) -> Any:
    """A detector for each thread, as threads that share one abort the process."""
    import locus  # type: ignore[import-not-found]

    cache = _of_thread.__dict__
    if family not in cache:
        tags = [getattr(locus.TagFamily, _LOCUS_FAMILIES[family])]
        cache[family] = locus.Detector(families=tags, threads=1)
    return cache[family]


def _cv2_qr(grey: np.ndarray, target: Target) -> Attempt:
    """OpenCV's QRCodeDetector."""
    detector, text = cv2.QRCodeDetector(), None
    try:
        text, quad, _ = detector.detectAndDecode(grey)
    except cv2.error:  # OpenCV 5 raises it for symbols that it cannot decode
        quad = detector.detect(grey)[1]
    every = [] if quad is None else [quad.reshape(4, 2) + 0.5]
    return attempt_of([(text, quad) for quad in every], target, every)


def _zxing(grey: np.ndarray, target: Target, enlarged: tuple[float, float] = (1.0, 1.0)) -> Attempt:
    """zxing-cpp with its defaults, for QR codes."""
    codes = zxingcpp.read_barcodes(
        grey, formats=QR_ONLY, text_mode=zxingcpp.TextMode.Plain, return_errors=True
    )
    every = [corners_of(code) / enlarged for code in codes]
    texts = (code.text if code.valid else None for code in codes)
    return attempt_of(zip(texts, every, strict=True), target, every)


def _zxing_tall(grey: np.ndarray, target: Target) -> Attempt:
    """zxing-cpp on an image enlarged more in height than in width, against foreshortening, and cropped to
    rows that differ from the background."""
    top, bottom = _content_rows(grey)
    part = np.ascontiguousarray(grey[top:bottom])
    moved = Target(target.kind, target.family, target.id, target.payload, target.corners - (0.0, top))
    was_found = False
    for across, taller in product(ENLARGE, UNFORESHORTEN):
        # cubic interpolation preserves the contrast of modules of one pixel
        tall = cv2.resize(part, None, fx=across, fy=across * taller, interpolation=cv2.INTER_CUBIC)
        attempt = _zxing(tall, moved, (across, tall.shape[0] / part.shape[0]))
        was_found = was_found or attempt.found
        if attempt.read:
            assert attempt.corners is not None
            return Attempt(True, True, attempt.corners + np.array([0.0, top]))
    return Attempt(was_found, False)


_READERS: dict[str, dict[str, Callable[[np.ndarray, Target], Attempt]]] = {
    "apriltag": {"aruco": _aruco, "pupil": _pupil, "locus": _locus},
    "aruco": {"aruco": _aruco, "locus": _locus},
    "qr": {"cv2": _cv2_qr, "zxing": _zxing, "zxing-tall": _zxing_tall},
}
_LOCUS_FAMILIES = {
    **{"36h11": "AprilTag36h11", "16h5": "AprilTag16h5", "mip_36h12": "ArUcoMip36h12"},
    **{name: f"ArUco{name}" for name in ("4x4_50", "4x4_100", "6x6_250")},
}
_OPTIONAL = {"pupil": ("pupil_apriltags", "pupil-apriltags"), "locus": ("locus", "locus-tag")}
"""module and package of detectors that may be missing"""
TITLES = {
    "aruco": "OpenCV aruco",
    "pupil": "AprilTag library (pupil-apriltags)",
    "locus": "locus-tag",
    "cv2": "OpenCV QRCodeDetector",
    "zxing": "zxing-cpp",
    "zxing-tall": "zxing-cpp, un-foreshortened",
}
"""titles of the detectors"""


def readers(kind: str, family: str | None = None) -> tuple[str, ...]:
    """Names of the installed detectors for "apriltag", "aruco" or "qr", of a family if it is given."""
    missing = missing_readers()
    return tuple(
        name
        for name in _READERS[kind]
        if name not in missing and (name != "locus" or family is None or family in _LOCUS_FAMILIES)
    )


def missing_readers() -> dict[str, str]:
    """Packages that must be installed for the detectors that are missing, by the detector's name."""
    return {name: package for name, (module, package) in _OPTIONAL.items() if find_spec(module) is None}


def attempt_of(
    decoded: Iterable[tuple[int | str | None, np.ndarray]], target: Target, every: Iterable[np.ndarray] = ()
) -> Attempt:
    """The result for a target among ids or texts with corners. every: quadrilaterals, decoded or not."""
    expected = target.payload if target.id is None else target.id
    corners = [quad for name, quad in decoded if name is not None and name == expected]
    if not corners:
        return Attempt(_any_over(every, target), False)
    nearest = min(corners, key=lambda quad: float(np.linalg.norm(quad - target.corners)))
    return Attempt(True, True, nearest)


def attempt(name: str, grey: np.ndarray, target: Target) -> Attempt:
    """Run one detector on an image. Thread-safe.

    Args:
        name: a name from `readers` for the target's kind.
        grey: (h, w) uint8.

    Raises InputError for an unknown name.
    """
    known = _READERS.get(target.kind, {})
    if name not in known:
        raise InputError(f"unknown detector {name!r} for {target.kind}; known: {', '.join(known)}")
    return known[name](grey, target)


def reader_versions() -> dict[str, str]:
    """Versions of the detectors' packages."""
    versions = {"opencv": cv2.__version__}
    for package in ("zxing-cpp", *(package for _, package in _OPTIONAL.values())):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of the convex hulls of two quadrilaterals (4, 2), 0 to 1."""
    a, b = (cv2.convexHull(np.asarray(quad, np.float32)) for quad in (one, other))
    shared, _ = cv2.intersectConvexConvex(a, b)
    union = cv2.contourArea(a) + cv2.contourArea(b) - shared
    return float(shared / union) if union > 0 else 0.0


def _any_over(quads: Iterable[np.ndarray], target: Target) -> bool:
    return any(overlap(quad, target.corners) > MIN_OVERLAP for quad in quads)


def _content_rows(grey: np.ndarray) -> tuple[int, int]:
    """Range of rows that differ from the level of the first pixel, with a margin."""
    level = int(grey[0, 0])
    rows = np.flatnonzero((grey.max(1) > level + 2) | (grey.min(1) < level - 2))
    if rows.size == 0:
        return 0, grey.shape[0]
    return max(int(rows[0]) - _MARGIN, 0), min(int(rows[-1]) + 1 + _MARGIN, grey.shape[0])
