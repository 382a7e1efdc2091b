"""The kinds of markers that specs can name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fidsplat.markers import boards, images, qr, svg, tags
from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError

_kinds = {kind.name: kind for module in (tags, qr, images, svg, boards) for kind in module.KINDS}


def register(kind: Kind) -> None:
    """Let specs name one more kind of marker, in this process.

    Raises:
        InputError: its name is taken, or cannot begin a spec.
    """
    if kind.name in _kinds:
        raise InputError(f"there is a kind of marker {kind.name!r} already; give yours another name")
    if not kind.name.isalnum() or kind.name != kind.name.lower():
        raise InputError(
            f"{kind.name!r} cannot begin a spec; a kind's name has lower-case letters and digits"
        )
    _kinds[kind.name] = kind


def kind_of(spec: Spec) -> Kind:
    """The kind that a spec names."""
    return _kinds[spec.kind]


def parse_spec(text: str) -> Spec:
    """Take a marker spec apart: apriltag:36h11:5, aruco:4x4_50:7, qr:TEXT, qr-v22-L:TEXT, image:FILE.png,
    svg:FILE.svg, charuco:7x5:4x4_50, gridboard:5x7:4x4_50, aprilgrid:6x6:36h11.

    A QR spec may leave out version (the smallest that holds the text) or level (L).

    Raises:
        InputError: not a spec, an unknown version or level, an id that is not a number.
    """
    if not isinstance(text, str):
        raise InputError(f"a marker spec is text ({_forms()}), not {text!r}")
    head, colon, rest = text.partition(":")
    if not colon:
        raise InputError(f"{text!r} is not a marker spec; write {_forms()}")
    kind = _named(head)
    if kind is None:
        raise InputError(f"unknown kind of marker {head.lower()!r}; write {_forms()}")
    return kind.parse(text, head, rest)


def bits_of(spec: Spec) -> tuple[Spec, np.ndarray]:
    """The modules of a marker, (h, w) uint8, 1 = dark, without quiet zone, and the spec with its family set.

    Raises:
        InputError: an unknown family, an id outside it, a text too long for the version, a file that cannot
            be read as a one-bit image.
    """
    return kind_of(spec).bits(spec)


def with_file(text: str, change: Callable[[str], str]) -> str:
    """A spec whose file, if it names one, is put elsewhere."""
    head, colon, rest = text.partition(":")
    kind = _named(head)
    return head + colon + change(rest) if rest and kind is not None and kind.is_file else text


def _named(head: str) -> Kind | None:
    """The kind that the head of a spec names, its options left out."""
    return _kinds.get(head.lower()) or _kinds.get(head.lower().partition("-")[0])


def _forms() -> str:
    forms = list(dict.fromkeys(kind.form for kind in _kinds.values()))
    return ", ".join(forms[:-1]) + f" or {forms[-1]}"
