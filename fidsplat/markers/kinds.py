"""Registry of the kinds of markers, and parsing of specs."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from fidsplat.images.family_names import foreign_family
from fidsplat.markers import boards, codes, stag, svg
from fidsplat.markers.spec import Detector, Kind, Spec
from fidsplat.util.arguments import instance, invalid
from fidsplat.util.errors import InputError, closest, did_you_mean
from fidsplat.util.plugins import load_plugins

_kinds = {kind.name: kind for module in (codes, stag, svg, boards) for kind in module.KINDS}


def register(kind: Kind) -> None:
    """Add a kind of marker for specs in this process. Installed packages add theirs by an entry point of the
    group `fidsplat.markers` that names the Kind.

    Raises:
        InputError: a name that exists or is invalid.
    """
    if not isinstance(instance("kind", kind, Kind).name, str):
        raise invalid("the name of a kind", "text", kind.name)
    if kind.name in _kinds:
        raise InputError(f"the name of a kind must not exist yet, got {kind.name!r}; use another name")
    if not kind.name.isalnum() or kind.name != kind.name.lower():
        raise InputError(f"the name of a kind must be lower-case letters and digits, got {kind.name!r}")
    _kinds[kind.name] = kind


def detectors(default: bool = False) -> dict[str, Detector]:
    """Detectors of the registered kinds, also of installed packages, by kind. default: only those that
    `detect` uses without `families`."""
    load_plugins("fidsplat.markers", register)
    return {
        name: kind.detect
        for name, kind in _kinds.items()
        if kind.detect is not None and (kind.default or not default)
    }


def kind_of(spec: Spec) -> Kind:
    """The kind of a spec."""
    return _kinds[spec.kind]


def parse_spec(text: str) -> Spec:
    """Parse a marker spec: apriltag:36h11:5 or tag36h11:5, aruco:4x4_50:7 or DICT_4X4_50:7, qr:TEXT,
    qr-v22-L:TEXT, image:FILE.png, svg:FILE.svg, stag:hd21:0, charuco:7x5:4x4_50, gridboard:5x7:4x4_50,
    aprilgrid:6x6:36h11.

    A QR spec may omit the version (default the smallest for the text) or the level (L).

    Raises:
        InputError: an invalid spec, an unknown version or level, an id that is not a number.
    """
    if not isinstance(text, str):
        raise InputError(f"a marker spec must be text ({_forms()}), got {text!r}")
    head, colon, rest = text.partition(":")
    if not colon:
        raise InputError(f"a marker spec must be one of {_forms()}, got {text!r}{_hint(text)}")
    kind = _named(head)
    foreign = foreign_family(head) if kind is None else None
    if foreign is not None:
        head, rest = foreign[0], f"{foreign[1]}:{rest}"
        kind = _kinds[head]
    if kind is None:
        raise InputError(f"unknown kind of marker {head.lower()!r}{_hint(text)}; write {_forms()}")
    return kind.parse(text, head, rest)


def bits_of(spec: Spec) -> tuple[Spec, np.ndarray]:
    """The modules of a marker, (h, w) uint8, 1 = dark, without quiet zone, and the spec with its family set.

    Raises:
        InputError: an unknown family, an id outside it, a text too long for the version, a file that cannot
            be read as a one-bit image.
    """
    return kind_of(spec).bits(spec)


def with_file(text: str, change: Callable[[str], str]) -> str:
    """Change the file name in a spec by a function; other specs stay the same."""
    head, colon, rest = instance("a marker spec", text, str).partition(":")
    kind = _named(head)
    return head + colon + change(rest) if rest and kind is not None and kind.is_file else text


def _named(head: str) -> Kind | None:
    """The kind that the head of a spec names, with or without options; loads installed packages if
    necessary."""
    names = (head.lower(), head.lower().partition("-")[0])
    if _kinds.keys().isdisjoint(names) and foreign_family(head) is None:
        load_plugins("fidsplat.markers", register)
    return _kinds.get(names[0]) or _kinds.get(names[1])


def _hint(text: str) -> str:
    """The most similar kind, or spec of a tag, as a question in brackets; empty if none is similar."""
    from fidsplat.images.tag_dictionaries import families

    specs = {
        f"{prefix}{name}": f"{kind}:{name}"
        for kind in ("apriltag", "aruco")
        for name in families(kind)
        for prefix in ("tag" if kind == "apriltag" else "dict_", kind, "")
    }
    name = text[:100].lower()
    head = name if name in specs else re.sub(r"[:,_ ]\d+$", "", name)
    near = closest(head, [*_kinds, *specs], 0.7)
    if near in specs:
        return f" (did you mean '{specs[near]}:{name[len(head) + 1 :] or 'ID'}'?)"
    return did_you_mean(text.partition(":")[0], _kinds)


def _forms() -> str:
    forms = list(dict.fromkeys(kind.form for kind in _kinds.values()))
    return ", ".join(forms[:-1]) + f" or {forms[-1]}"
