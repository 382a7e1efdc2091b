"""AprilTags and ArUco tags: the dictionaries that OpenCV predefines."""

from __future__ import annotations

import re

import numpy as np

from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError


def _parse(text: str, head: str, rest: str) -> Spec:
    kind = head.lower()
    family, _, number = rest.rpartition(":")
    if not family:
        raise InputError(f"{text!r} lacks a family or an id; write {kind}:FAMILY:ID")
    if not re.fullmatch(r"[0-9]{1,9}", number):
        raise InputError(f"{text!r}: the id {number!r} is not a whole number from 0")
    return Spec(text=text, kind=kind, family=family.lower(), id=int(number))


def _bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    from fidsplat.images.tag_dictionaries import dictionary_bits

    return spec, dictionary_bits(spec.kind, spec.family or "", spec.id or 0)


KINDS = tuple(Kind(name, f"{name}:FAMILY:ID", 1, _parse, _bits) for name in ("apriltag", "aruco"))
