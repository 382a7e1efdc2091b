"""AprilTags detected by the AprilTag library, through pupil-apriltags (extra `experiments`)."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from fidsplat.util.errors import DeviceError

MANY_CODES = 10_000
"""Codes of a family from which one wrong bit is corrected, instead of two: a table for two bits has 4 GB."""

_idle: dict[str, deque] = {}
"""idle detectors by family"""


def read_tags(grey: np.ndarray, family: str) -> list[tuple[int, np.ndarray]]:
    """Detect the tags of a family, such as "36h11" or "standard41h12", at full resolution. Thread-safe.

    grey: (h, w) uint8. Returns ids and corners, (4, 2) pixels of the border, TL, TR, BR, BL as printed.
    """
    idle = _idle.setdefault(family, deque())
    try:
        detector = idle.pop()  # one image at a time: a detector has scratch memory
    except IndexError:
        detector = _detector(family)
    detections: Any = detector.detect(grey)  # a list, in spite of the annotation
    idle.append(detector)
    return [(tag.tag_id, tag.corners[::-1].copy()) for tag in detections]


def _detector(family: str):
    try:
        import pupil_apriltags  # type: ignore[import-not-found]
    except ImportError as error:
        raise DeviceError(
            f"pupil-apriltags must be installed to detect apriltag:{family}, got none; "
            "pip install pupil-apriltags"
        ) from error

    class Detector(pupil_apriltags.Detector):
        # the library frees the family before the detector that uses it, which can crash: one detector for
        # each thread is never freed
        def __del__(self) -> None:
            pass

    # the constructor would add the family with a table for two wrong bits
    detector = Detector(families="tag16h5", nthreads=1, quad_decimate=1.0)
    library: Any = detector.libc
    pointer = detector.tag_detector_ptr
    library.apriltag_detector_clear_families.restype = None
    library.apriltag_detector_clear_families(pointer)
    create = getattr(library, f"tag{family.capitalize()}_create")
    create.restype = type(next(iter(detector.tag_families.values())))
    created = create()
    bits = 1 if created.contents.ncodes > MANY_CODES else 2
    library.apriltag_detector_add_family_bits(pointer, created, bits)
    detector.tag_families["added"] = created
    return detector
