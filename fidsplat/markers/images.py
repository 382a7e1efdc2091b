"""Markers from images of two grey levels, with one pixel per module."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError


def _parse(text: str, head: str, rest: str) -> Spec:
    if not rest:
        raise InputError(f"the spec of an image must be image:FILE.png, got {text!r}")
    return Spec(text=text, kind="image", payload=rest)


def _bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    from fidsplat.images.files import read_bits

    return spec, np.ascontiguousarray(read_bits(Path(spec.payload or "")), np.uint8)


KINDS = (Kind("image", "image:FILE.png", 0, _parse, _bits, is_file=True),)
