"""What a picture's outputs add to the stages: one file for each, which declares an `Output`.

A file needs no other place to be known: a picture that asks for an output of that name gets what its file
declares, and kernels of other pictures hold nothing of it.
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
    """What one output, or a part that several need, adds to the stages; by default nothing.

    Fields are name: type. Functions are Warp's; their parameters stand here by name. `pixel`, `seen`,
    `layer`, `samples` and `out` are structs with the fields that all of a picture's outputs declare, so
    their types are `Any`; a function whose first parameter is such a struct, or a record, returns it changed.
    """

    needs: tuple[str, ...] = ()
    """other files here whose fields this one reads"""
    depth: bool = False
    """whether `seen.z` is read: depth of what shows [m]"""
    length: bool = False
    """whether lengths of rays are read: what turns a depth into a distance"""

    record: tuple[str, ...] = ()
    """numbers of a splat's record"""
    project: Any = None
    """(record, at, normal, height): puts them into record[at], record[at + 1] ...; normal: of the splat's
    plane in the camera frame; height: of the camera above it, with its side [m]"""

    seen: Mapping[str, Any] = field(default_factory=dict)
    """what a fragment shows, and a layer, whose fragments have their mean by optical depth"""
    see: Any = None
    """(seen, numbers, index): numbers: the vector of those of the record; index: of the splat"""
    layer: Mapping[str, Any] = field(default_factory=dict)
    """what a layer keeps besides the sums `layer.mean` of what its fragments show"""
    gather: Any = None
    """(layer, seen, tau): the layer with a fragment of optical depth tau"""
    average: Any = None
    """(seen, tau): from the sums of a layer of optical depth tau what it shows"""

    state: Mapping[str, Any] = field(default_factory=dict)
    """what a sample keeps while its list is composited; 0 before the first fragment"""
    start: Any = None
    """(pixel, length, view): other first values; length: of the sample's ray, 1 unless `length`"""
    fragment: Any = None
    """(pixel, s, c, x, y, dot, opacity, view): a splat that the sample's tile lists, whether its fragment is
    drawn or not (c.drawn), before it is composited; x, y: from the anchor; dot: squared distance from the
    projected centre in pixels, infinite without a low-pass; opacity: 0 of one that is not drawn"""
    attenuate: Any = None
    """(pixel, seen, shown): how much of a fragment's weight shows as its colour, of `shown`"""
    composite: Any = None
    """(pixel, seen, weight, shown, view): a fragment or a layer of this weight, before `pixel.t` changes"""
    cover: Any = None
    """(seen): what an opaque surface of another renderer shows, where that is not 0"""
    clear: Any = None
    """(pixel): where less than 1/255 of the sample is covered, which shows nothing"""
    samples: Mapping[str, Any] = field(default_factory=dict)
    """sample buffers between blending and resolving, by the type of an element"""
    store: Any = None
    """(pixel, at, samples): fills them"""
    light: bool = False
    """whether they are light: the mean of what several poses leave, not one pose's"""

    cloud_arrays: Mapping[str, Any] = field(default_factory=dict)
    """arrays of the cloud that resolving reads as out.NAME, by the type of an element"""
    view_arrays: Mapping[str, Any] = field(default_factory=dict)
    """the same of the view (`View.array`)"""
    hidden: Any = None
    """(grid, samples): share of the background that shows besides what is transmitted"""
    resolve: Any = None
    """(grid, samples, lengths, out): a pixel of the output image out.NAME from its samples; lengths: a
    vector with a float for each of them, of rays if `length`"""
    over: str = ""
    """the output whose image `resolve` changes once that is resolved, of a file without one of its own"""


def known() -> frozenset[str]:
    """Names of all files."""
    return frozenset(module.name for module in pkgutil.iter_modules(__path__))


def declared(name: str) -> Output:
    """What the file of this name declares."""
    return import_module(f".{name}", __name__).OUTPUT


def with_needed(names: Iterable[str]) -> tuple[str, ...]:
    """These and all that they need, sorted."""
    found: set[str] = set()
    todo = list(names)
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            todo += declared(name).needs
    return tuple(sorted(found))


def having(names: Iterable[str], *parts: str) -> tuple[str, ...]:
    """Those that declare at least one of these parts."""
    return tuple(name for name in names if any(getattr(declared(name), part) for part in parts))


def fields(names: Iterable[str], part: str) -> dict[str, Any]:
    """The fields of this part of all of them.

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
    """The functions that they have for this part."""
    return tuple(getattr(declared(name), part) for name in having(names, part))


def digest(names: Iterable[str]) -> str:
    """16 hexadecimal digits of these files' text, for the name of a kernel that calls their functions.

    Warp keeps a compiled kernel by the text of all functions that it calls, but for those that one of them
    takes from a tuple in a loop, as all do that ask every output: it would draw with what stood there before.
    """
    text = hashlib.blake2b(digest_size=8)
    for name in names:
        spec = find_spec(f".{name}", __name__)
        text.update(Path(str(spec and spec.origin)).read_bytes())
    return text.hexdigest()
