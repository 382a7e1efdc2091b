"""Data classes of parsed marker specs and of kinds of markers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from shapely import MultiPolygon


@dataclass(frozen=True, kw_only=True)
class Spec:
    """A parsed marker spec; kinds with more fields extend it."""

    text: str
    """text of the spec"""
    kind: str
    """name of the kind of marker, e.g. "apriltag\""""
    family: str | None = None
    """tag family, a name of OpenCV's dictionaries; "v5-L" for a QR code once it is encoded"""
    id: int | None = None
    """tag id"""
    payload: str | None = None
    """QR text, or the path of an image or an SVG drawing"""
    colors: tuple[tuple[float, float, float], ...] | None = None
    """RGB of the values 0, 1, ... once modules are made; None: white and black"""
    outside: int = 0
    """modules of the code on each side of the square that `size` measures: data bits of AprilTag 3"""
    regions: tuple[MultiPolygon, ...] | None = None
    """region of each value for drawings with slanted or curved edges, in modules from the top left; else
    None"""


Detector = Callable[[np.ndarray], Iterable[tuple[str, np.ndarray]]]
"""Called with an image, (h, w) uint8 grey; returns the spec and the corners of each code, (4, 2) pixels TL,
TR, BR, BL as printed. The first pixel has its centre at (0.5, 0.5)."""


@dataclass(frozen=True)
class Kind:
    """A kind of marker, added by `fidsplat.markers.register`."""

    name: str
    """prefix of its specs, in lower case; options may follow after a dash: "qr", "qr-v22-L\""""
    form: str
    """form of its specs for messages: "apriltag:FAMILY:ID\""""
    quiet_zone: int
    """default width of the quiet zone in modules"""
    parse: Callable[[str, str, str], Spec]
    """parses a spec: called with the spec and its parts before and after the first colon; raises
    InputError"""
    bits: Callable[[Any], tuple[Spec, np.ndarray]]
    """called with the result of `parse`; returns it with the family, and the modules without quiet zone, (h,
    w) uint8, 1 = dark or an index of the spec's colours, 255 = no paper (a hole); raises InputError"""
    is_file: bool = False
    """whether the part after the colon is a file name, relative to the scene file"""
    detect: Detector | None = None
    """detector of such markers, for `fidsplat.vision.detect`; None: there is none"""
    default: bool = True
    """whether `detect` without families includes them"""
