"""Flat source texts from a FeatureSet and the shape of a device. Needs no OpenCL.

They are two programs, as most feature sets list and sort their splats alike: drivers keep what they have
compiled by its text, so that the program `lists` is compiled once for all of those.

A stage's file, or a section of an effect's, has hooks, lines `//@@ name`, where the sections `//@ name` of
the chosen effects go, and lines `//@@ struct NAME` and `//@@ arguments KERNEL`, where the declarations of
layout.py are printed. What nobody fills leaves an empty line, so the text names no effect that was not asked
for; `#line` directives say where each line comes from.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np

from fidsplat.backends.opencl.declare import Argument, Layout, Record, Samples, Scalars, output_argument
from fidsplat.backends.opencl.effect_layouts import LAYOUTS
from fidsplat.backends.opencl.layout import BOUNDS, KERNELS, SPLAT, VIEW
from fidsplat.backends.opencl.shapes import DeviceShape
from fidsplat.effects import FeatureSet
from fidsplat.util.errors import DeviceError
from fidsplat.util.kernel_files import kernels_folder

_LISTS = {
    "ordered": ("scan", "sort", "bin"),
    "tiled": ("tile_lists",),
    "gathered": ("tile_lists", "tile_lists_local"),
}
"""stages of the program `lists`, by the way of listing"""
_DRAWN = (
    "prelude",
    "math",
    "splat",
    "bounds",
    "project",
    "pack",
    "blend",
    "schedule/{}_cells",
    "schedule/{}",
    "resolve",
)
"""stages of the program `picture`, with the way in which a device walks tiles; only splats that are listed in
order are packed"""
_HOOK = re.compile(r"[ \t]*//@@ (\w+)(?: (\w+))?[ \t]*")
_SECTION = re.compile(r"//@ (\w+)[ \t]*")
_KERNEL = re.compile(r"^kernel\b.*?\bvoid (\w+)\(", re.MULTILINE)
# both begin with a word itself, which re finds 20 times as fast as a boundary
_WIDE_CONSTANT = re.compile(r"WIDE\(([^()]+)\)")
_WIDE = re.compile(r"wide(?<=\bwide)\b")
_DECLARED = ("struct", "arguments")


@dataclass(frozen=True)
class Text:
    """A program's text."""

    listing: str
    """with comments, to be read"""
    compiled: str
    """the same without them, line for line"""


@dataclass(frozen=True)
class Source:
    """Flat kernel sources with what the host must know of them."""

    programs: dict[str, Text]
    """`lists` and `picture`"""
    records: dict[str, np.dtype]
    """`View`, `Splat` and `Bounds` as the kernels have them"""
    arguments: dict[str, tuple[Argument, ...]]
    """of each kernel of the texts"""
    samples: tuple[tuple[Samples, bool], ...]
    """what passes from blending to resolving, and whether several shots are averaged there"""
    scalars: Scalars

    @property
    def listing(self) -> str:
        """All programs, to be read."""
        return "".join(program.listing for program in self.programs.values())

    @property
    def text(self) -> str:
        """All programs as they are compiled, one after the other."""
        return "".join(program.compiled for program in self.programs.values())

    @property
    def digest(self) -> str:
        """SHA-256 of the text: the cache key."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def layouts_of(features: FeatureSet) -> dict[str, Layout]:
    """The layouts of all effects, in the order in which their text is put together: those of which there is
    one of each kind, parts, outputs, what changes rgb."""
    chosen = (*features.slots, *features.outputs, *features.posts)
    parts = _parts_of(chosen)
    outputs = [name for name in features.outputs if name not in parts]
    return {name: LAYOUTS[name] for name in (*features.slots, *sorted(parts), *outputs, *features.posts)}


def _parts_of(names: Iterable[str]) -> set[str]:
    """What layouts need, and what that needs."""
    parts: set[str] = set()
    chosen = list(names)
    todo = chosen.copy()
    while todo:
        needed = LAYOUTS[todo.pop()].parts
        for slot in chosen:
            needed = [dict(LAYOUTS[part].behind).get(slot, part) for part in needed]
        fresh = set(needed) - parts
        parts |= fresh
        todo += fresh
    return parts


def assemble(features: FeatureSet, shape: DeviceShape) -> Source:
    """The source text of all stages for these features on a device of this shape.

    Raises:
        DeviceError: an effect's file fills a hook that no file has.
    """
    layouts = layouts_of(features)
    fused = _resolves_fused(features, layouts)
    declared = Declarations(layouts, features, fused)
    files = [layout.file for layout in layouts.values() if layout.file]
    files.append(LAYOUTS["resolve_pixel"].file)
    if shape.schedule == "lanes" and "camera_pinhole" in layouts:
        # disks and 3D Gaussians among each other are not asked: their images are bounded otherwise
        if "lowpass_screen" in layouts and "thickness" not in layouts:
            files.append(LAYOUTS["cull_frustum"].file)
        if "lowpass_pixel" in layouts and "thickness" not in layouts:
            files.append(LAYOUTS["cull_frustum_pixel"].file)
        if "ellipsoids_only" in layouts:
            files.append(LAYOUTS["cull_frustum_ewa"].file)
    if fused:
        files.append(LAYOUTS["resolve_fused"].file)
    if shape.lists == "tiled":
        files.append("list/tiled.cl")
    if "compose_pixel" in layouts:
        files.append(LAYOUTS[f"k_buffer_{shape.schedule}"].file)
    elif shape.schedule == "lanes":
        files.append(LAYOUTS["tile_loop_lanes"].file)
    if "termination_depths" in layouts:  # after the k-buffer, which may repeat the pass through a list
        way = "_pixel" if "compose_pixel" in layouts else ""
        files += [LAYOUTS["termination_depth_pixel"].file] if way else []
        files.append(LAYOUTS[f"termination_depth{way}_{shape.schedule}"].file)
    if "external_depth" in layouts:  # after the k-buffer is empty
        files.append(LAYOUTS["external_depth_end"].file)
    stages = {
        "lists": ("prelude", "math", "bounds", *_LISTS[shape.lists]),
        "picture": [
            stage.format(shape.schedule)
            for stage in _DRAWN
            if not (stage == "pack" and shape.lists != "ordered") and not (stage == "resolve" and fused)
        ],
    }
    _refuse_unknown_hooks(files)
    writer = Writer(files, declared, numbers_of(features, shape))
    programs = {name: writer.program(name, stages[name]) for name in stages}
    kernels = (kernel for each in programs.values() for kernel in kernels_in(each))
    arguments = {kernel: declared.arguments(kernel) for kernel in kernels}
    return Source(programs, declared.records, arguments, declared.samples, declared.scalars)


def _resolves_fused(features: FeatureSet, layouts: Mapping[str, Layout]) -> bool:
    """Whether who has drawn a pixel resolves it too, which saves a launch: where a pixel is one
    sample of one pose, and nothing but blending adds to it."""
    alone = features.samples == 1 and "background_constant" in layouts and "rays" not in layouts
    return alone and not any(name.startswith("shutter_") for name in layouts)


def numbers_of(features: FeatureSet, shape: DeviceShape) -> dict[str, int]:
    """The build constants, by their names in the kernels."""
    numbers = {
        "CHUNKS": shape.chunks,
        "FAST_FMA": int(shape.fast_fma),
        "LANES": shape.lanes,
        "RADIX_BITS": shape.radix_bits,
        "SAMPLES": features.samples,
        "SCAN_ITEMS": shape.scan_items,
        "SETUP_FP64": int(features.setup_precision == "float64"),
        "SH_DEGREE": features.sh_degree,
        "TILE_H": shape.tile_height,
        "TILE_W": shape.tile_width,
        "K_BUFFER_SIZE": shape.k_buffer_size,
    }
    if shape.schedule == "group":
        numbers["ROWS"] = shape.rows
    return numbers


class Writer:
    """Puts programs together from stage files, whose hooks effects' files and declarations fill."""

    def __init__(
        self,
        files: Iterable[str],
        declared: Declarations,
        defines: Mapping[str, int],
    ) -> None:
        """files: of the effects, below kernels/opencl/, in the order in which they fill a hook."""
        self._sections = [(file, sections_of(file)) for file in files]
        self._declared, self._defines = declared, defines

    def program(self, name: str, stages: Iterable[str]) -> Text:
        """The program of these stage files."""
        files = [f"{stage}.cl" for stage in stages]
        body = "".join(f"#line 1 {_shown(file)}\n{self._expand(file, 1, lines_of(file))}" for file in files)
        body = with_scalars(with_constants(body, self._declared.constants), self._declared.scalars.wide)
        bare = "\n".join(_without_comment(line) if "//" in line else line for line in body.split("\n"))
        # a number that a program does not name must not make another program
        numbers = sorted(self._defines.items())
        head = "".join(f"#define {name} {value}\n" for name, value in numbers if name in bare)
        return Text(f"// the program `{name}`\n{head}{body}", f"\n{head}{bare}")

    def _fill(self, hook: str, subject: str) -> Iterator[str]:
        if hook in _DECLARED:
            yield f'#line 1 "layout.py: {subject}"\n{self._declared.text(hook, subject)}'
        for file, by_hook in self._sections:
            for first, lines in by_hook.get(hook, ()):
                yield f"#line {first} {_shown(file)}\n{self._expand(file, first, lines)}"

    def _expand(self, file: str, first: int, lines: tuple[str, ...]) -> str:
        made = []
        for number, line in enumerate(lines, first):
            hook = _HOOK.fullmatch(line) if "//@@" in line else None
            if hook is None:
                made.append(line)
                continue
            filled = "".join(self._fill(hook[1], hook[2] or ""))
            made.append(f"{filled}#line {number + 1} {_shown(file)}" if filled else "")
        return "\n".join(made) + "\n"


def kernels_in(text: Text) -> list[str]:
    """Names of a program's kernels."""
    return _KERNEL.findall(text.compiled)


class Declarations:
    """What layout.py declares, with what the chosen effects add to it."""

    def __init__(self, layouts: dict[str, Layout], features: FeatureSet, fused: bool = False) -> None:
        """fused: blending resolves, with the arguments of both."""
        real = "double" if features.setup_precision == "float64" else "float"
        self.scalars = Scalars(real, "double" if "blend_double" in layouts else "float")
        self.samples = tuple((one, layout.averaged) for layout in layouts.values() for one in layout.samples)
        self._layouts, self._outputs, self._resolves_fused = layouts, features.images, fused
        every = layouts.values()
        self.constants = dict(one for layout in every for one in layout.constant)
        """fields of `Splat` that all splats share, and their values"""
        splat = SPLAT.with_members(one for layout in every for one in layout.splat)
        self._structs: dict[str, Record] = {
            "View": VIEW.with_members(one for layout in every for one in layout.view),
            "Splat": splat.without(self.constants),
            "Bounds": BOUNDS.with_members(one for layout in every for one in layout.bounds),
        }
        self.records: dict[str, np.dtype] = {}
        self.add(*self._structs.values())

    def add(self, *records: Record) -> None:
        """Further structs that kernels may ask for."""
        self._structs |= {record.name: record for record in records}
        self.records |= {record.name: record.dtype(self.scalars) for record in records}

    def arguments(self, kernel: str) -> tuple[Argument, ...]:
        """Its own, then those of the effects in their order, each name once."""
        every = self._layouts.values()
        added: list[Argument] = []
        if kernel in ("project", "blend", "backdrop", "resolve"):
            added += (one for layout in every for one in getattr(layout, kernel))
        if kernel in ("blend", "resolve"):
            access = "out" if kernel == "blend" else "in"
            added += (Argument(one.ctype, one.name, access, note=one.note) for one, _ in self.samples)
        if kernel == "resolve":
            added += map(output_argument, self._outputs)
        if kernel == "blend" and self._resolves_fused:
            own = {"stride", *(one.name for one in (*KERNELS[kernel], *added))}
            added += [one for one in self.arguments("resolve") if one.name not in own]
        return tuple({one.name: one for one in (*KERNELS[kernel], *added)}.values())

    def text(self, hook: str, subject: str) -> str:
        """C for `//@@ struct NAME` or `//@@ arguments KERNEL`."""
        if hook == "struct":
            return self._structs[subject].text(self.scalars)
        arguments = self.arguments(subject)
        lines = [f"    {one.text}{',' if one is not arguments[-1] else ''}" for one in arguments]
        notes = [f"  // {one.note}" if one.note else "" for one in arguments]
        return "".join(f"{line}{note}\n" for line, note in zip(lines, notes, strict=True))


@cache
def _shown(file: str) -> str:
    """What `#line` calls a file: its path below kernels/, or its name if it is not from there."""
    return f'"{Path(file).name}"' if Path(file).is_absolute() else f'"opencl/{file}"'


def _without_comment(line: str) -> str:
    return line[: line.index("//")].rstrip(" \t")


def with_scalars(text: str, wide: str = "float") -> str:
    """Kernel text in which the type `wide` and its constants are those of C."""
    return _WIDE.sub(wide, _WIDE_CONSTANT.sub(r"\1" if wide == "double" else r"\1f", text))


def with_constants(text: str, constants: Mapping[str, str]) -> str:
    """Kernel text in which fields of `Splat` that no record holds are read as their values, and not
    written."""
    if not constants:
        return text
    names = "|".join(constants)
    text = re.sub(rf"\brecord\.(?:{names}) = [^;\n]*;", "", text)
    return re.sub(rf"\bs(?:->|\.)({names})\b", lambda read: constants[read[1]], text)


def _refuse_unknown_hooks(files: list[str]) -> None:
    stages = (stage.format(schedule) for stage in _DRAWN for schedule in ("lanes", "group"))
    everywhere = {f"{stage}.cl" for stage in (*stages, *chain(*_LISTS.values()))}
    everywhere |= {layout.file for layout in LAYOUTS.values() if layout.file}
    known = {hook for file in everywhere for hook in _hooks(file)}
    for file in files:
        if unknown := set(sections_of(file)) - known:
            raise DeviceError(f"kernel file {file} fills hooks that no file has: {sorted(unknown)}")


def kernel_text(path: str) -> str:
    """A file below kernels/opencl/, as it stands."""
    return "\n".join(lines_of(path)) + "\n"


def section_text(path: str, hook: str) -> str:
    """What an effect's file has for a hook."""
    return "".join("\n".join(lines) + "\n" for _, lines in sections_of(path)[hook])


@cache
def lines_of(path: str) -> tuple[str, ...]:
    """The lines of a file below kernels/opencl/."""
    return tuple((kernels_folder() / "opencl" / path).read_text(encoding="utf-8").splitlines())


@cache
def _hooks(path: str) -> tuple[str, ...]:
    found = (_HOOK.fullmatch(line) for line in lines_of(path))
    return tuple(hook[1] for hook in found if hook)


@cache
def sections_of(path: str) -> dict[str, list[tuple[int, tuple[str, ...]]]]:
    """The sections of an effect's file, by the hook that each fills: number of the first line, and lines."""
    lines = lines_of(path)
    starts = [(k, match[1]) for k, line in enumerate(lines) if (match := _SECTION.fullmatch(line))]
    ends = [k for k, _ in starts[1:]] + [len(lines)]
    sections: dict[str, list[tuple[int, tuple[str, ...]]]] = {}
    for (start, hook), end in zip(starts, ends, strict=True):
        sections.setdefault(hook, []).append((start + 2, lines[start + 1 : end]))
    return sections
