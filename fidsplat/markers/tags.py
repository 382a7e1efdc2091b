"""AprilTags and ArUco tags: OpenCV's predefined dictionaries, and the families of AprilTag 3."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from fidsplat.images.apriltag3 import outside
from fidsplat.images.family_names import canonical_family
from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError


def _parse(text: str, head: str, rest: str) -> Spec:
    kind = head.lower()
    family, _, number = rest.rpartition(":")
    if not family:
        raise InputError(f"the spec of a tag must be {kind}:FAMILY:ID, got {text!r}")
    if not re.fullmatch(r"[0-9]{1,9}", number):
        raise InputError(f"the id of {text!r} must be a whole number from 0, got {number!r}")
    return Spec(text=text, kind=kind, family=canonical_family(family), id=int(number))


def _bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    from fidsplat.images.tag_dictionaries import dictionary_bits

    bits = dictionary_bits(spec.kind, spec.family or "", spec.id or 0)
    return replace(spec, outside=outside(spec.family)), bits


KINDS = tuple(Kind(name, f"{name}:FAMILY:ID", 1, _parse, _bits) for name in ("apriltag", "aruco"))
