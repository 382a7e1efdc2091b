"""QR codes, made by segno in byte mode."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError

_HEAD = re.compile(r"qr(?:-v(?P<version>\d+))?(?:-(?P<level>[A-Za-z]))?", re.IGNORECASE)
_LEVELS = "LMQH"
_VERSIONS = range(1, 41)
_DEFAULT_LEVEL = "L"


@dataclass(frozen=True, kw_only=True)
class QrSpec(Spec):
    """A QR code's spec."""

    version: int | None = None
    """1 to 40, if the spec asks for one"""
    level: str = _DEFAULT_LEVEL
    """error level, one of L, M, Q, H"""


def _parse(text: str, head: str, rest: str) -> QrSpec:
    code = _HEAD.fullmatch(head)
    if code is None:
        raise InputError(f"a QR spec must be qr:TEXT, qr-v22-L:TEXT, qr-v22:TEXT or qr-L:TEXT, got {head!r}")
    version, level = code["version"], code["level"]
    number = None if version is None else int(version)
    if number is not None and number not in _VERSIONS:
        raise InputError(
            f"QR version {number} does not exist; versions are {_VERSIONS[0]} to {_VERSIONS[-1]}"
        )
    level = (level or _DEFAULT_LEVEL).upper()
    if level not in _LEVELS:
        raise InputError(f"QR error level {level!r} does not exist; levels are {', '.join(_LEVELS)}")
    if not rest:
        raise InputError(f"{text!r} holds no text to encode")
    return QrSpec(text=text, kind="qr", payload=rest, version=number, level=level)


def _bits(spec: QrSpec) -> tuple[Spec, np.ndarray]:
    """Byte mode at exactly the requested level; without a requested version the smallest that fits."""
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


KINDS = (Kind("qr", "qr:TEXT, qr-v22-L:TEXT", 4, _parse, _bits),)
