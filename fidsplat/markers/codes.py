"""Tags, QR codes and images as markers: parsing of their specs, and their modules.

Families of tags are OpenCV's predefined dictionaries and those of AprilTag 3; segno encodes QR codes, in
byte mode; images have two grey levels and one pixel per module.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fidsplat.images.apriltag3 import outside
from fidsplat.images.family_names import canonical_family
from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError

_HEAD = re.compile(r"qr(?:-v(?P<version>\d+))?(?:-(?P<level>[A-Za-z]))?", re.IGNORECASE)
_LEVELS = "LMQH"
_VERSIONS = range(1, 41)
_DEFAULT_LEVEL = "L"


def _parse_tag(text: str, head: str, rest: str) -> Spec:
    kind = head.lower()
    family, _, number = rest.rpartition(":")
    if not family:
        raise InputError(f"the spec of a tag must be {kind}:FAMILY:ID, got {text!r}")
    if not re.fullmatch(r"[0-9]{1,9}", number):
        raise InputError(f"the id of {text!r} must be a whole number from 0, got {number!r}")
    return Spec(text=text, kind=kind, family=canonical_family(family), id=int(number))


def _tag_bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    from fidsplat.images.tag_dictionaries import dictionary_bits

    bits = dictionary_bits(spec.kind, spec.family or "", spec.id or 0)
    return replace(spec, outside=outside(spec.family)), bits


@dataclass(frozen=True, kw_only=True)
class QrSpec(Spec):
    version: int | None = None
    """1 to 40; None for the smallest"""
    level: str = _DEFAULT_LEVEL
    """error level, one of L, M, Q, H"""


def _parse_qr(text: str, head: str, rest: str) -> QrSpec:
    code = _HEAD.fullmatch(head)
    if code is None:
        raise InputError(f"a QR spec must be qr:TEXT, qr-v22-L:TEXT, qr-v22:TEXT or qr-L:TEXT, got {head!r}")
    version, level = code["version"], code["level"]
    number = None if version is None else int(version)
    if number is not None and number not in _VERSIONS:
        raise InputError(f"the version of a QR code must be {_VERSIONS[0]} to {_VERSIONS[-1]}, got {number}")
    level = (level or _DEFAULT_LEVEL).upper()
    if level not in _LEVELS:
        raise InputError(f"the error level of a QR code must be {', '.join(_LEVELS)}, got {level!r}")
    if not rest:
        raise InputError(f"a QR spec must have a text, for example qr:hello, got {text!r}")
    return QrSpec(text=text, kind="qr", payload=rest, version=number, level=level)


def _qr_bits(spec: QrSpec) -> tuple[Spec, np.ndarray]:
    """Modules of a QR code in byte mode, at exactly the requested level; by default the smallest version."""
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
            f"the text must have at most {qr_capacity(version, spec.level)} bytes in a QR code of version "
            f"{version} at level {spec.level}, got {size}; shorten it"
            + ("" if version == _VERSIONS[-1] else ", or use a higher version")
            + ("" if spec.level == "L" else ", or a lower level")
        ) from None
    except UnicodeEncodeError:
        raise InputError(f"a QR text must be encodable as UTF-8, got {spec.text!r}") from None
    bits = np.array([list(row) for row in code.matrix], np.uint8)
    return replace(spec, family=f"v{code.version}-{code.error}", version=int(code.version)), bits


def _encoding(text: str) -> str:
    """Encoding of a text: ISO 8859-1, the default of readers, if possible, else UTF-8, which they detect."""
    try:
        text.encode("iso-8859-1")
    except UnicodeEncodeError:
        return "utf-8"
    return "iso-8859-1"


def qr_capacity(version: int, level: str) -> int:
    """Capacity in bytes of a QR code in byte mode, by version (1 to 40) and level (L, M, Q, H)."""
    from segno import consts

    bits = consts.SYMBOL_CAPACITY[version][consts.ERROR_MAPPING[level]]
    return (bits - 4 - (8 if version < 10 else 16)) // 8


def _parse_image(text: str, head: str, rest: str) -> Spec:
    if not rest:
        raise InputError(f"the spec of an image must be image:FILE.png, got {text!r}")
    return Spec(text=text, kind="image", payload=rest)


def _image_bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    from fidsplat.images.files import read_bits

    return spec, np.ascontiguousarray(read_bits(Path(spec.payload or "")), np.uint8)


KINDS = (
    *(Kind(name, f"{name}:FAMILY:ID", 1, _parse_tag, _tag_bits) for name in ("apriltag", "aruco")),
    Kind("qr", "qr:TEXT, qr-v22-L:TEXT", 4, _parse_qr, _qr_bits),
    Kind("image", "image:FILE.png", 0, _parse_image, _image_bits, is_file=True),
)
