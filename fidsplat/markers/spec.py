"""What a marker spec says once it is taken apart, and what a kind of marker has to offer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from shapely import MultiPolygon


@dataclass(frozen=True, kw_only=True)
class Spec:
    """A marker spec taken apart. Kinds that have more to say extend it."""

    text: str
    """the spec as it was written"""
    kind: str
    """name of the kind of marker, e.g. "apriltag\""""
    family: str | None = None
    """tag family as OpenCV's dictionaries name it; for QR "v5-L" once the code is made"""
    id: int | None = None
    """tag id"""
    payload: str | None = None
    """QR text, or the path of an image or an SVG drawing"""
    colors: tuple[tuple[float, float, float], ...] | None = None
    """RGB of modules of the values 0, 1, ..., once they are made; None: white and black"""
    regions: tuple[MultiPolygon, ...] | None = None
    """of each value what it covers, in modules from the top left, where it is more than whole modules"""


@dataclass(frozen=True)
class Kind:
    """A kind of marker. `fidsplat.markers.register` adds one, after which its specs work in that process."""

    name: str
    """what its specs begin with, in lower case; options may follow after a dash: "qr", "qr-v22-L\""""
    form: str
    """what a spec looks like, for messages: "apriltag:FAMILY:ID\""""
    quiet_zone: int
    """modules of white around it unless the caller says otherwise"""
    parse: Callable[[str, str, str], Spec]
    """called with the spec, its part before the first colon and the part after it; raises InputError"""
    bits: Callable[[Any], tuple[Spec, np.ndarray]]
    """called with what ``parse`` gave; returns it, its family set, and the modules without quiet zone,
    (h, w) uint8, 1 = dark or an index into the spec's colours; raises InputError"""
    is_file: bool = False
    """whether the part after the colon is a file name, relative to the scene file"""
