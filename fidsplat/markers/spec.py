"""Marker specs: the text by which users name a marker, and the bits that it stands for."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fidsplat.errors import InputError

FORMS = "apriltag:FAMILY:ID, aruco:FAMILY:ID, qr:TEXT, qr-v22-L:TEXT or image:FILE.png"

QUIET_ZONE = {"apriltag": 1, "aruco": 1, "qr": 4, "image": 0}
"""Modules of white around a code unless the caller says otherwise."""

_QR = re.compile(r"qr(?:-v(?P<version>\d+))?(?:-(?P<level>[A-Za-z]))?", re.IGNORECASE)
_LEVELS = "LMQH"
_VERSIONS = range(1, 41)
_DEFAULT_LEVEL = "L"


@dataclass(frozen=True)
class Spec:
    """A marker spec taken apart; `bits_of` turns it into modules."""

    text: str
    """the spec as it was written"""
    kind: str
    """"apriltag", "aruco", "qr" or "image\""""
    family: str | None = None
    """tag family as OpenCV's dictionaries name it; for QR "v5-L" once the code is made"""
    id: int | None = None
    """tag id"""
    payload: str | None = None
    """QR text, or the image's path"""
    version: int | None = None
    """QR version 1 to 40 if the spec asks for one"""
    level: str = _DEFAULT_LEVEL
    """QR error level, one of L, M, Q, H"""


def parse_spec(text: str) -> Spec:
    """Take a marker spec apart: apriltag:36h11:5, aruco:4x4_50:7, qr:TEXT, qr-v22-L:TEXT, image:FILE.png.

    A QR spec may leave out version (the smallest that holds the text) or level (L).

    Raises:
        InputError: not a spec, an unknown version or level, an id that is no number.
    """
    if not isinstance(text, str):
        raise InputError(f"a marker spec is text ({FORMS}), not {text!r}")
    head, colon, rest = text.partition(":")
    kind = head.lower()
    if not colon:
        raise InputError(f"{text!r} is not a marker spec; write {FORMS}")
    if kind in ("apriltag", "aruco"):
        family, _, number = rest.rpartition(":")
        if not family:
            raise InputError(f"{text!r} lacks a family or an id; write {kind}:FAMILY:ID")
        if not re.fullmatch(r"[0-9]{1,9}", number):
            raise InputError(f"{text!r}: the id {number!r} is not a whole number from 0")
        return Spec(text, kind, family=family.lower(), id=int(number))
    if kind == "image":
        if not rest:
            raise InputError(f"{text!r} names no file; write image:FILE.png")
        return Spec(text, kind, payload=rest)
    if code := _QR.fullmatch(head):
        return _qr_spec(text, code["version"], code["level"], rest)
    if kind.startswith("qr"):
        raise InputError(
            f"{head!r} is no kind of QR code; write qr:TEXT, qr-v22-L:TEXT, qr-v22:TEXT or qr-L:TEXT"
        )
    raise InputError(f"unknown kind of marker {head!r}; write {FORMS}")


def _qr_spec(text: str, version: str | None, level: str | None, payload: str) -> Spec:
    number = None if version is None else int(version)
    if number is not None and number not in _VERSIONS:
        raise InputError(
            f"QR version {number} does not exist; versions are {_VERSIONS[0]} to {_VERSIONS[-1]}"
        )
    level = (level or _DEFAULT_LEVEL).upper()
    if level not in _LEVELS:
        raise InputError(f"QR error level {level!r} does not exist; levels are {', '.join(_LEVELS)}")
    if not payload:
        raise InputError(f"{text!r} holds no text to encode")
    return Spec(text, "qr", payload=payload, version=number, level=level)


def bits_of(spec: Spec) -> tuple[Spec, np.ndarray]:
    """The modules of a marker, (h, w) uint8, 1 = dark, without quiet zone, and the spec with its family set.

    Raises:
        InputError: an unknown family, an id outside it, a text too long for the version, a file that cannot
            be read as a one-bit picture.
    """
    if spec.kind == "qr":
        return _qr_bits(spec)
    if spec.kind == "image":
        from fidsplat.vision.images import read_bits

        return spec, np.ascontiguousarray(read_bits(Path(spec.payload or "")), np.uint8)
    from fidsplat.vision.dictionaries import dictionary_bits

    return spec, dictionary_bits(spec.kind, spec.family or "", spec.id or 0)


def _qr_bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    """Byte mode at exactly the level asked for; a version that is not asked for is the smallest that fits."""
    import segno
    from segno.encoder import DataOverflowError

    payload = spec.payload or ""
    try:
        encoding = _encoding(payload)
        options = {"version": spec.version, "encoding": encoding, "mode": "byte", "boost_error": False}
        code = segno.make_qr(payload, error=spec.level, **options)
    except DataOverflowError:
        version, size = spec.version or _VERSIONS[-1], len(payload.encode(_encoding(payload)))
        raise InputError(
            f"the text takes {size} bytes, but a QR code of version {version} at level {spec.level} "
            f"holds {qr_capacity(version, spec.level)}; shorten it"
            + ("" if version == _VERSIONS[-1] else ", or ask for a higher version")
            + ("" if spec.level == "L" else ", or a lower level")
        ) from None
    except UnicodeEncodeError:
        raise InputError(f"{spec.text!r} holds characters that cannot be encoded as UTF-8") from None
    bits = np.array([list(row) for row in code.matrix], np.uint8)
    return replace(spec, family=f"v{code.version}-{code.error}", version=int(code.version)), bits


def _encoding(text: str) -> str:
    """ISO 8859-1, which readers assume, where the text fits into it; else UTF-8, which they recognise."""
    try:
        text.encode("iso-8859-1")
    except UnicodeEncodeError:
        return "utf-8"
    return "iso-8859-1"


def qr_capacity(version: int, level: str) -> int:
    """Bytes that a QR code of that version (1 to 40) and level (L, M, Q, H) holds in byte mode."""
    from segno import consts

    bits = consts.SYMBOL_CAPACITY[version][consts.ERROR_MAPPING[level]]
    return (bits - 4 - (8 if version < 10 else 16)) // 8
