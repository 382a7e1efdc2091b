"""Outputs, one file each. A file declares an `Output`: fields and functions that it adds to the stages.

A file is found by its name. Kernels of frames without an output contain nothing of it.
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
    """Additions of an output, or of a part shared by several outputs, to the stages; by default none.

    Fields are name: type. Functions are Warp's; their parameters are given here. `pixel`, `attributes`,
    `layer`, `samples` and `out` are structs with the fields of all outputs of a frame, so their types are
    `Any`; a function whose first parameter is such a struct, or a record, returns it changed.
    """

    needs: tuple[str, ...] = ()
    """other files here whose fields this one reads"""
    depth: bool = False
    """whether `attributes.z`, the depth of the fragment [m], is read"""
    length: bool = False
    """whether ray lengths are read, which convert depths to distances"""

    record: tuple[str, ...] = ()
    """numbers that are added to a splat's record"""
    project: Any = None
    """(record, at, normal, height): stores them in record[at], record[at + 1] ...; normal: of the splat's
    plane in the camera frame; height: signed height of the camera above it [m]"""

    attributes: Mapping[str, Any] = field(default_factory=dict)
    """of a fragment, and of a layer: the mean of its fragments by optical depth"""
    read_attributes: Any = None
    """(attributes, numbers, index): numbers: the vector of those of the record; index: of the splat"""
    layer: Mapping[str, Any] = field(default_factory=dict)
    """state of a layer in addition to the means `layer.mean` of its fragments' attributes"""
    accumulate: Any = None
    """(layer, attributes, tau, share): adds a fragment of optical depth tau, which is this share of the
    layer's, to a layer"""

    state: Mapping[str, Any] = field(default_factory=dict)
    """fields added to the state of a sample while its list is composited; initially 0"""
    start: Any = None
    """(pixel, length, view): sets other initial values; length: of the sample's ray, 1 unless `length`"""
    fragment: Any = None
    """(pixel, s, c, x, y, disc, opacity, view): a splat of the tile's list before it is composited, whether
    it contributes to the sample or not (c.contributes); x, y: from the anchor; disc: squared distance from
    the projected centre in pixels, infinite without a low-pass; opacity: 0 if it does not contribute"""
    composite: Any = None
    """(pixel, attributes, weight, view): a fragment or a layer of this weight, before `pixel.t`
    changes"""
    cover: Any = None
    """(attributes): attributes of an external opaque surface, where they are not 0"""
    clear: Any = None
    """(pixel): for samples of which less than 1/255 is covered"""
    samples: Mapping[str, Any] = field(default_factory=dict)
    """sample buffers between blending and resolving, by the type of an element"""
    store: Any = None
    """(pixel, at, samples): fills them"""
    light: bool = False
    """whether these buffers are averaged over sub-frames, like colours; otherwise they are from one pose"""

    cloud_arrays: Mapping[str, Any] = field(default_factory=dict)
    """arrays of the cloud that resolving reads as out.NAME, by the type of an element"""
    view_arrays: Mapping[str, Any] = field(default_factory=dict)
    """arrays of the view (`View.array`), likewise"""
    background_share: Any = None
    """(grid, samples): share of the background that is visible in addition to the transmittance"""
    resolve: Any = None
    """(grid, samples, lengths, out): a pixel of the output image out.NAME from its samples; lengths: a
    vector with a float for each of them, of rays if `length`"""
    over: str = ""
    """the output whose resolved image `resolve` changes, if it has no image of its own"""


def known() -> frozenset[str]:
    """Names of all files."""
    return frozenset(module.name for module in pkgutil.iter_modules(__path__))


def declared(name: str) -> Output:
    """The declaration in the file of this name."""
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
    """Names of files that declare at least one of these parts."""
    return tuple(name for name in names if any(getattr(declared(name), part) for part in parts))


def fields(names: Iterable[str], part: str) -> dict[str, Any]:
    """Fields of a part, of all files.

    Raises:
        ValueError: two of them declare one name.
    """
    union: dict[str, Any] = {}
    for name in names:
        own = getattr(declared(name), part)
        if twice := union.keys() & own.keys():
            raise ValueError(f"the Warp output {name} declares {part} {min(twice)!r}, which another has too")
        union |= own
    return union


def functions(names: Iterable[str], part: str) -> tuple[Any, ...]:
    """Functions of a part, of all files that have one."""
    return tuple(getattr(declared(name), part) for name in having(names, part))


def digest(names: Iterable[str]) -> str:
    """16 hexadecimal digits of these files' text, for the name of a kernel that calls their functions.

    Warp caches a compiled kernel by the text of all functions that it calls, except those that are called
    from a tuple in a loop, as functions of outputs are: changes of them would not be noticed.
    """
    text = hashlib.blake2b(digest_size=8)
    for name in names:
        spec = find_spec(f".{name}", __name__)
        text.update(Path(str(spec and spec.origin)).read_bytes())
    return text.hexdigest()
