"""What declarations of the kernels' data are made of, and what is made from them: C text, NumPy types, and
the kinds of arguments that the host binds. The declarations themselves stand in layout.py, those of effects
in effect_layouts.py.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fidsplat.effects import Output

Access = Literal["", "in", "out"]
Source = Literal["stage", "cloud", "uniform", "array"]
_KINDS: dict[str, tuple[Access, Source]] = {
    **{"in": ("in", "stage"), "out": ("out", "stage")},
    **{"cloud": ("in", "cloud"), "array": ("in", "array")},
}
_NAME = re.compile(r"(\w+)(?:\[(\d+)\])?")
_TYPES = {"float": "f4", "int": "i4", "uint": "u4", "short": "i2", "ulong": "u8", "double": "f8"}


@dataclass(frozen=True)
class Member:
    """Fields of a record, or places in a buffer of one record, that have one type and one remark."""

    ctype: str
    names: tuple[tuple[str, int], ...]
    """with their lengths; 1: no array"""
    note: str = ""

    @property
    def text(self) -> str:
        """The line of C that declares them."""
        names = ", ".join(name if length == 1 else f"{name}[{length}]" for name, length in self.names)
        return f"    {self.ctype} {names};" + (f"  // {self.note}" if self.note else "") + "\n"


def member(declaration: str, note: str = "") -> Member:
    """From the type and the names, as in C but without commas: `real rotation[9]`, `wide r g b`."""
    ctype, *names = declaration.split()
    found = [_NAME.fullmatch(name) for name in names]
    return Member(ctype, tuple((match[1], int(match[2] or 1)) for match in found if match), note)


@dataclass(frozen=True)
class Scalars:
    """What the two types are that depend on the build."""

    real: str
    """of the per-splat set-up: float or double"""
    wide: str
    """of fragments"""

    def of(self, ctype: str) -> str:
        """The type of C that `ctype` stands for."""
        return {"real": self.real, "wide": self.wide}.get(ctype, ctype)

    def dtype(self, ctype: str) -> np.dtype:
        """NumPy's type for one of C's."""
        return np.dtype(_TYPES[self.of(ctype)])


@dataclass(frozen=True)
class Record:
    """A struct that host and kernels, or two kernels, both know."""

    name: str
    members: tuple[Member, ...]
    alignment: int = 1
    """bytes of which its size is a multiple"""

    def with_members(self, members: Iterable[Member]) -> Record:
        """The record with more members behind its own."""
        return Record(self.name, (*self.members, *members), self.alignment)

    def without(self, names: Collection[str]) -> Record:
        """The record without these fields, which keep their order."""
        kept = (
            Member(one.ctype, tuple(field for field in one.names if field[0] not in names), one.note)
            for one in self.members
        )
        return Record(self.name, tuple(one for one in kept if one.names), self.alignment)

    def dtype(self, scalars: Scalars) -> np.dtype:
        """Its layout: that of C, by natural alignment."""
        fields = [
            (name, scalars.dtype(one.ctype), *(((length,),) if length > 1 else ()))
            for one in self.members
            for name, length in one.names
        ]
        plain = np.dtype(fields, align=True)
        size = plain.itemsize + -plain.itemsize % self.alignment
        known = plain.fields or {}
        return np.dtype(
            {
                "names": list(known),
                "formats": [known[name][0] for name in known],
                "offsets": [known[name][1] for name in known],
                "itemsize": size,
            }
        )

    def text(self, scalars: Scalars) -> str:
        """The C struct, and a line that does not compile where its size is not the host's."""
        aligned = f" __attribute__((aligned({self.alignment})))" if self.alignment > 1 else ""
        size = self.dtype(scalars).itemsize
        check = f"typedef char {self.name}_has_the_size_that_the_host_knows"
        check += f"[(sizeof({self.name}) == {size}) ? 1 : -1];"
        body = "".join(one.text for one in self.members)
        return f"typedef struct{aligned} {{\n{body}}} {self.name};\n{check}\n"


@dataclass(frozen=True)
class Argument:
    """One argument of a kernel."""

    ctype: str
    name: str
    access: Access
    """of a buffer: whether the kernel only reads it; empty: a number"""
    source: Source = "stage"
    """Who gives it: the stage that is launched, or what it holds by this name; the cloud; a uniform of the
    view (`View.uniform`); an array of the view (`View.array`)."""
    uniform: tuple[str, int] = ("", 0)
    """of which group of uniforms it is which"""
    note: str = ""

    @property
    def text(self) -> str:
        """As it stands in the kernel's signature."""
        if not self.access:
            return f"{self.ctype} {self.name}"
        const = "const " if self.access == "in" else ""
        return f"global {const}{self.ctype} *restrict {self.name}"


def takes(*declared: str | tuple[Argument, ...]) -> tuple[Argument, ...]:
    """Arguments from lines of words, and others among them as they are.

    A line is a type, names that have it, and a remark behind `//`. Alone it declares numbers that the stage
    gives (`int width height`); behind `in` buffers of the stage that the kernel reads (`in float raw  // 4
    channels`), behind `out` those that it changes, behind `cloud` arrays with a row for each splat, behind
    `array` those that the view has on the host and that are copied to the device for the picture.
    """
    found: list[Argument] = []
    for one in declared:
        if not isinstance(one, str):
            found += one
            continue
        words, _, note = one.partition("//")
        kind, *rest = words.split()
        access, source = _KINDS.get(kind, ("", "stage"))
        ctype, *names = rest if kind in _KINDS else (kind, *rest)
        found += (Argument(ctype, name, access, source, note=note.strip()) for name in names)
    return tuple(found)


def uniforms(group: str, *declarations: str, note: str = "") -> tuple[Argument, ...]:
    """All numbers of a group of uniforms of the view (`View.uniform`), in its order."""
    words = [declaration.split() for declaration in declarations]
    named = [(ctype, name) for ctype, *names in words for name in names]
    return tuple(
        Argument(ctype, name, "", "uniform", (group, place), note)
        for place, (ctype, name) in enumerate(named)
    )


@dataclass(frozen=True)
class Samples:
    """A sample buffer: channels, one after the other, that pass from blending to resolving for an effect."""

    ctype: str
    name: str
    channels: int = 1
    note: str = ""


@dataclass(frozen=True)
class Layout:
    """How OpenCL lays out an effect: what it adds to records and to the arguments of kernels."""

    file: str = ""
    """below kernels/opencl/; empty: no text of its own"""
    parts: tuple[str, ...] = ()
    """other layouts that it needs: parts, or outputs whose samples it reads"""
    splat: tuple[Member, ...] = ()
    constant: tuple[tuple[str, str], ...] = ()
    """(field of `Splat`, value): every splat has it, so that no record holds it and kernels read the value"""
    bounds: tuple[Member, ...] = ()
    view: tuple[Member, ...] = ()
    project: tuple[Argument, ...] = ()
    blend: tuple[Argument, ...] = ()
    backdrop: tuple[Argument, ...] = ()
    resolve: tuple[Argument, ...] = ()
    samples: tuple[Samples, ...] = ()
    averaged: bool = False
    """Whether its samples are light: the mean of what several sub-frames leave, not one sub-frame's."""
    backward_file: str = ""
    """derivatives, below kernels/opencl/; empty: no text of their own"""
    moments: tuple[Member, ...] = ()
    """fields of `Moments` (layout.py)"""
    blend_backward: tuple[Argument, ...] = ()
    project_backward: tuple[Argument, ...] = ()
    behind: tuple[tuple[str, str], ...] = ()
    """(camera or another slot, part): where that is chosen that part takes this one's place"""


def output_argument(output: Output) -> Argument:
    """Where a kernel puts an output image."""
    ctype = {"float32": "float", "int32": "int"}[output.dtype]
    shape = "(h, w)" if output.channels == 1 else f"(h, w, {output.channels})"
    return Argument(ctype, f"{output.name}_out", "out", note=shape)
