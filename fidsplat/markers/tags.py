"""AprilTags and ArUco tags of OpenCV's predefined dictionaries."""

from __future__ import annotations

import re

import numpy as np

from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError


def _parse(text: str, head: str, rest: str) -> Spec:
    kind = head.lower()
    family, _, number = rest.rpartition(":")
    if not family:
        raise InputError(f"the spec of a tag must be {kind}:FAMILY:ID, got {text!r}")
    if not re.fullmatch(r"[0-9]{1,9}", number):
        raise InputError(f"the id of {text!r} must be a whole number from 0, got {number!r}")
    return Spec(text=text, kind=kind, family=family.lower(), id=int(number))


def _bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    from fidsplat.images.tag_dictionaries import dictionary_bits

    return spec, dictionary_bits(spec.kind, spec.family or "", spec.id or 0)


KINDS = tuple(Kind(name, f"{name}:FAMILY:ID", 1, _parse, _bits) for name in ("apriltag", "aruco"))
