"""Outputs, one file each. A file declares an `Output`: fields and functions that are added to the stages.

Files are found by their names. Kernels contain only the code of requested outputs.
"""

from __future__ import annotations

import hashlib
import pkgutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Output:
    """Code that an output, or a file shared by several outputs, adds to the stages; none by default.

    Fields are name: type. Functions are Warp's; their parameters are given here. `pixel`, `attributes`,
    `layer`, `samples` and `out` are structs with the fields of all outputs of a frame, so their types are
    `Any`. A function whose first parameter is such a struct, or a record, returns the changed struct or
    record.
    """

    needs: tuple[str, ...] = ()
    """other files of this folder whose fields this file reads"""
    depth: bool = False
    """whether `attributes.z`, the depth of the fragment [m], is read"""
    length: bool = False
    """whether the lengths of rays are read, which convert depths to distances"""

    record: tuple[str, ...] = ()
    """numbers that are added to a splat's record"""
    project: Any = None
    """(record, at, normal, height): stores these numbers in record[at], record[at + 1] ...; normal: normal of
    the splat's plane in the camera frame; height: signed distance of the camera from the plane [m]"""

    attributes: Mapping[str, Any] = field(default_factory=dict)
    """fields of a fragment; for a layer, their means weighted by optical depth"""
    read_attributes: Any = None
    """(attributes, numbers, index): sets the fields; numbers: vector of the numbers in `record`; index: index
    of the splat"""
    layer: Mapping[str, Any] = field(default_factory=dict)
    """state of a layer in addition to the means `layer.mean` of its fragments' attributes"""
    accumulate: Any = None
    """(layer, attributes, tau, share): adds a fragment to a layer; tau: optical depth of the fragment; share:
    tau as a fraction of the layer's optical depth"""

    state: Mapping[str, Any] = field(default_factory=dict)
    """fields added to the state of a sample while its list is composited; initially 0"""
    start: Any = None
    """(pixel, length, view): sets other initial values; length: length of the sample's ray if `length`, else
    1"""
    fragment: Any = None
    """(pixel, s, c, x, y, disc, alpha, view): called for every splat of the tile's list before it is
    composited, also if it does not contribute (c.contributes); x, y: position relative to the anchor; disc:
    squared distance from the projected centre in pixels, infinite without a low-pass; alpha: 0 if the splat
    does not contribute"""
    composite: Any = None
    """(pixel, attributes, weight, view): called for a fragment or layer before it attenuates `pixel.t`"""
    cover: Any = None
    """(attributes): sets attributes of an external opaque surface that are not 0"""
    clear: Any = None
    """(pixel): called for samples with an alpha below 1/255"""
    samples: Mapping[str, Any] = field(default_factory=dict)
    """sample buffers between blending and resolving, by the type of an element"""
    store: Any = None
    """(pixel, at, samples): writes the sample buffers"""
    averaged: bool = False
    """whether these buffers are averaged over sub-frames, like colours; otherwise they are from one pose"""

    cloud_arrays: Mapping[str, Any] = field(default_factory=dict)
    """arrays of the cloud that the resolve stage reads as out.NAME, by the type of an element"""
    view_arrays: Mapping[str, Any] = field(default_factory=dict)
    """arrays of the view (`View.array`) that the resolve stage reads as out.NAME"""
    background_share: Any = None
    """(grid, samples): share of the background that is visible in addition to the transmittance"""
    resolve: Any = None
    """(grid, samples, lengths, out): writes a pixel of the output image out.NAME; lengths: vector with the
    ray length of each sample if `length`"""
    over: str = ""
    """output whose resolved image `resolve` changes, for files without an image"""


def known() -> frozenset[str]:
    """Names of all files."""
    return frozenset(module.name for module in pkgutil.iter_modules(__path__))


def declared(name: str) -> Output:
    """Declaration in the file of this name."""
    return import_module(f".{name}", __name__).OUTPUT


def with_needed(names: Iterable[str]) -> tuple[str, ...]:
    """Add dependencies to names; returns all, sorted."""
    found: set[str] = set()
    todo = list(names)
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            todo += declared(name).needs
    return tuple(sorted(found))


def having(names: Iterable[str], *parts: str) -> tuple[str, ...]:
    """Names of files that declare at least one of these fields of `Output`."""
    return tuple(name for name in names if any(getattr(declared(name), part) for part in parts))


def fields(names: Iterable[str], part: str) -> dict[str, Any]:
    """Merge a field of `Output` of all files.

    Raises:
        ValueError: two of them declare one name.
    """
    union: dict[str, Any] = {}
    for name in names:
        own = getattr(declared(name), part)
        if twice := union.keys() & own.keys():
            raise ValueError(
                f"{part} of the Warp output {name} must have new names, got {min(twice)!r}, which another "
                "output declares"
            )
        union |= own
    return union


def functions(names: Iterable[str], part: str) -> tuple[Any, ...]:
    """Functions of a field of `Output`, of all files that declare one."""
    return tuple(getattr(declared(name), part) for name in having(names, part))


def digest(names: Iterable[str]) -> str:
    """Hash of the text of files, 16 hexadecimal digits, for the name of a kernel that calls their functions.

    Warp caches a compiled kernel by the text of the functions that it calls, except functions in a tuple,
    such as the functions of outputs: without the hash, changes of these would have no effect.
    """
    text = hashlib.blake2b(digest_size=8)
    for name in names:
        spec = find_spec(f".{name}", __name__)
        text.update(Path(str(spec and spec.origin)).read_bytes())
    return text.hexdigest()
