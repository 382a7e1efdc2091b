"""Kernel declarations (structs, arguments, effects), and their translation to C text and NumPy types."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fidsplat.effects import Output

Access = Literal["", "in", "out"]
ValueSource = Literal["stage", "cloud", "uniform", "array"]
_KINDS: dict[str, tuple[Access, ValueSource]] = {
    **{"in": ("in", "stage"), "out": ("out", "stage")},
    **{"cloud": ("in", "cloud"), "array": ("in", "array")},
}
_NAME = re.compile(r"(\w+)(?:\[(\d+)\])?")
_TYPES = {"float": "f4", "int": "i4", "uint": "u4", "short": "i2", "ulong": "u8", "double": "f8"}


@dataclass(frozen=True)
class Member:
    """Fields of a record that share a type and a comment."""

    ctype: str
    names: tuple[tuple[str, int], ...]
    """(name, number of elements); 1: not an array"""
    note: str = ""


def member(declaration: str, note: str = "") -> Member:
    """Parse a type and names, as in C but without commas: `real rotation[9]`, `blend_real r g b`."""
    ctype, *names = declaration.split()
    matches = [_NAME.fullmatch(name) for name in names]
    return Member(ctype, tuple((match[1], int(match[2] or 1)) for match in matches if match), note)


@dataclass(frozen=True)
class ScalarTypes:
    """The C types that depend on the build."""

    real: str
    """type of the per-splat projection: float or double"""
    blend_real: str
    """type of fragments in the blend stage: float or double"""

    def dtype(self, ctype: str) -> np.dtype:
        """The NumPy type of a C type."""
        return np.dtype(_TYPES[{"real": self.real, "blend_real": self.blend_real}.get(ctype, ctype)])


@dataclass(frozen=True)
class Record:
    """A struct shared by host and kernels, or by two kernels."""

    name: str
    members: tuple[Member, ...]
    alignment: int = 1
    """bytes; the size is a multiple of it"""

    def with_members(self, members: Iterable[Member]) -> Record:
        return Record(self.name, (*self.members, *members), self.alignment)

    def without(self, names: Collection[str]) -> Record:
        """The record without these fields, in the same order."""
        members = []
        for member in self.members:
            if fields := tuple([field for field in member.names if field[0] not in names]):
                members.append(Member(member.ctype, fields, member.note))
        return Record(self.name, tuple(members), self.alignment)

    def dtype(self, scalar_types: ScalarTypes) -> np.dtype:
        """The C layout, by natural alignment."""
        fields = []
        for member in self.members:
            dtype = scalar_types.dtype(member.ctype)
            fields += [
                (name, dtype, (length,)) if length > 1 else (name, dtype) for name, length in member.names
            ]
        plain = np.dtype(fields, align=True)
        size = plain.itemsize + -plain.itemsize % self.alignment
        names = list(plain.fields or ())
        formats, offsets = zip(*(plain.fields or {}).values(), strict=True) if names else ((), ())
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})

    def text(self, size: int) -> str:
        """The C struct, with a compile-time check of its size in bytes."""
        aligned = f" __attribute__((aligned({self.alignment})))" if self.alignment > 1 else ""
        check = f"typedef char {self.name}_has_the_size_of_its_numpy_type"
        check += f"[(sizeof({self.name}) == {size}) ? 1 : -1];"
        body = ""
        for member in self.members:
            names = ", ".join([name if length == 1 else f"{name}[{length}]" for name, length in member.names])
            body += f"    {member.ctype} {names};" + (f"  // {member.note}" if member.note else "") + "\n"
        return f"typedef struct{aligned} {{\n{body}}} {self.name};\n{check}\n"


@dataclass(frozen=True)
class Argument:
    ctype: str
    name: str
    access: Access
    """access to a buffer: `in` if the kernel only reads it, else `out`; empty for a number"""
    source: ValueSource = "stage"
    """source of the value: the launch or frame, the cloud, or the view (`View.uniforms_of`, `View.array`)"""
    uniform: tuple[str, int] = ("", 0)
    """group of uniforms, and index in it"""
    note: str = ""

    @property
    def text(self) -> str:
        """The C text in the kernel's signature."""
        if not self.access:
            return f"{self.ctype} {self.name}"
        const = "const " if self.access == "in" else ""
        return f"global {const}{self.ctype} *restrict {self.name}"


def args(*declared: str | tuple[Argument, ...]) -> tuple[Argument, ...]:
    """Parse declarations of kernel arguments; tuples of arguments are inserted unchanged.

    A declaration is a type, names, and a note after `//`: `int width height` declares two numbers. A word
    before the type declares buffers: `in` (only read), `out` (written), `cloud` (with a row for each splat),
    `array` (copied from the view): `in float raw  // 4 channels`.
    """
    parsed: list[Argument] = []
    for declaration in declared:
        if not isinstance(declaration, str):
            parsed += declaration
            continue
        words, _, note = declaration.partition("//")
        kind, *rest = words.split()
        access, source = _KINDS.get(kind, ("", "stage"))
        ctype, *names = rest if kind in _KINDS else (kind, *rest)
        parsed += (Argument(ctype, name, access, source, note=note.strip()) for name in names)
    return tuple(parsed)


def uniforms(group: str, *declarations: str, note: str = "") -> tuple[Argument, ...]:
    """Arguments for all numbers of a group of uniforms (`View.uniforms_of`), in the order of the group."""
    words = [declaration.split() for declaration in declarations]
    named = [(ctype, name) for ctype, *names in words for name in names]
    return tuple(
        Argument(ctype, name, "", "uniform", (group, index), note)
        for index, (ctype, name) in enumerate(named)
    )


@dataclass(frozen=True)
class SampleBuffer:
    """Values per sample, written by the blend stage and read by the resolve stage."""

    ctype: str
    name: str
    channels: int = 1
    note: str = ""
    averaged: bool = False
    """whether sub-frames are averaged, as for colours; otherwise the middle sub-frame is used"""


@dataclass(frozen=True)
class EffectCode:
    """Kernel code of an effect, of an output, or of a part that several share: its file, and its additions to
    records and kernel arguments."""

    file: str = ""
    """file below kernels/opencl/; empty: none"""
    parts: tuple[str, ...] = ()
    """names of other code that it requires: parts, or outputs whose samples it reads"""
    splat: tuple[Member, ...] = ()
    constant: tuple[tuple[str, str], ...] = ()
    """(field of `Splat`, value): fields that are equal for all splats and become constants in the kernels"""
    packed: tuple[tuple[str, str], ...] = ()
    """(field of `Splat`, expression that reads it): packed fields (assemble.py)"""
    bounds: tuple[Member, ...] = ()
    view: tuple[Member, ...] = ()
    project: tuple[Argument, ...] = ()
    emit: tuple[Argument, ...] = ()
    blend: tuple[Argument, ...] = ()
    composite_background: tuple[Argument, ...] = ()
    resolve: tuple[Argument, ...] = ()
    sample_buffers: tuple[SampleBuffer, ...] = ()
    backward_file: str = ""
    """file of its derivatives below kernels/opencl/; empty: none"""
    record_gradient: tuple[Member, ...] = ()
    """fields of `RecordGradient` (kernel_interface.py)"""
    blend_backward: tuple[Argument, ...] = ()
    project_backward: tuple[Argument, ...] = ()
    project_step: tuple[Argument, ...] = ()
    replaced_by: tuple[tuple[str, str], ...] = ()
    """(effect, part): with that effect, the part replaces this one"""


def output_argument(output: Output) -> Argument:
    """The kernel argument of an output image."""
    ctype = {"float32": "float", "int32": "int"}[output.dtype]
    shape = "(h, w)" if output.channels == 1 else f"(h, w, {output.channels})"
    return Argument(ctype, f"{output.name}_out", "out", note=shape)
