"""Bits of the tags of OpenCV's aruco module (AprilTag and ArUco families) and of AprilTag 3."""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from fidsplat.images import apriltag3
from fidsplat.images.family_names import foreign_family
from fidsplat.util.errors import InputError, did_you_mean


class Family(NamedTuple):
    """Tag family: modules along an edge of the tag (data and border), and number of ids."""

    size: int
    count: int


_APRILTAG = ("16h5", "25h9", "36h10", "36h11", *apriltag3.LAYOUTS)
_ARUCO = (
    *(f"{n}x{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "original",
    "mip_36h12",
)
_KINDS = {"apriltag": _APRILTAG, "aruco": _ARUCO}

BORDER = 1


def families(kind: str | None = None) -> dict[str, Family]:
    """Families by name, such as {"36h11": Family(size=8, count=587), ...}. kind: "apriltag", "aruco", or None
    for both."""
    if kind is not None and kind not in _KINDS:
        raise InputError(f"kind of tag must be one of {', '.join(_KINDS)}, got {kind!r}")
    kinds = _KINDS if kind is None else (kind,)
    return {name: _family(k, name) for k in kinds for name in _KINDS[k]}


def parse_family(text: str) -> tuple[str, str]:
    """Split "apriltag:36h11", or "36h11", "tag36h11" or "DICT_APRILTAG_36h11", into (kind, family).
    Raises InputError for an unknown name; the message lists the families."""
    kind, colon, name = str(text).lower().rpartition(":")
    foreign = foreign_family(name)
    if foreign is not None and kind in ("", foreign[0]):
        kind, name = foreign
        colon = ":"
    for known, names in _KINDS.items():
        if name in names and (not colon or kind == known):
            return known, name
    known = "; ".join(f"{k}: {', '.join(names)}" for k, names in _KINDS.items())
    hint = did_you_mean(name, families())
    raise InputError(f"unknown tag family {text!r}{hint}; known are {known}")


def dictionary_bits(kind: str, family: str, tag_id: int) -> np.ndarray:
    """Modules of a tag, (size, size) uint8, 1 = dark, including the black border of one module. Row 0 is the
    top of the image of ``cv2.aruco.generateImageMarker``. Missing modules of round and recursive tags are
    255."""
    kind, family = parse_family(f"{kind}:{family}")
    size, count = _family(kind, family)
    if not 0 <= tag_id < count:
        raise InputError(f"{kind}:{family} ids must be 0 to {count - 1}, got {tag_id}")
    if family in apriltag3.LAYOUTS:
        return apriltag3.tag_bits(family, tag_id)
    printed = cv2.aruco.generateImageMarker(predefined(kind, family), int(tag_id), size, borderBits=BORDER)
    return (printed == 0).astype(np.uint8)


@cache
def predefined(kind: str, family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family. Raises InputError for families of AprilTag 3, which OpenCV lacks."""
    if family in apriltag3.LAYOUTS:
        raise InputError(f"the family must be one of OpenCV's dictionaries, got {kind}:{family}; e.g. 36h11")
    prefix = "DICT_APRILTAG_" if kind == "apriltag" else "DICT_ARUCO_" if "x" not in family else "DICT_"
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, (prefix + family).upper()))


def _family(kind: str, name: str) -> Family:
    if name in apriltag3.LAYOUTS:
        return Family(apriltag3.LAYOUTS[name].size, len(apriltag3.codes(name)))
    dictionary = predefined(kind, name)
    return Family(dictionary.markerSize + 2 * BORDER, len(dictionary.bytesList))
