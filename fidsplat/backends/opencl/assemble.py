"""One flat source text from a FeatureSet and the shape of a device.

A kernel file of an effect is cut at lines `//@ section`; a stage file, or a section, has lines `//@@ section`
where the sections of the chosen effects go. What nobody fills expands to nothing, so the text names no effect
that was not asked for.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cache

from fidsplat.effects import CATALOGUE, Effect, FeatureSet
from fidsplat.errors import DeviceError
from fidsplat.kernel_files import kernels_folder

BASE_RECORD_LANES, BASE_RECORD_SHORTS = 14, 6
RECORD_ALIGNMENT = 16
BASE_BOUNDS_BYTES = 32
_LISTS = {"ordered": ("scan", "sort", "bin", "pack"), "tiled": ("tiles",)}
_HOOK = re.compile(r"^[ \t]*//@@ (\w+)[ \t]*\n", re.MULTILINE)
_SECTION = re.compile(r"^//@ (\w+)[ \t]*\n", re.MULTILINE)
_COMMENT = re.compile(r"[ \t]*//[^\n]*")
_BLANK = re.compile(r"\n\s*\n+")
_WIDE_CONSTANT = re.compile(r"\bWIDE\(([^()]+)\)")
_WIDE = re.compile(r"\bwide\b")


@dataclass(frozen=True)
class DeviceShape:
    """Build constants that follow from the kind of device, not from the scene."""

    schedule: str
    """`lanes` (a tile per work-item, vectors across pixels) or `group` (a work-group per tile)."""
    lists: str
    """`ordered` (sort the splats by depth, then list them per tile in that order) or `tiled` (list them per
    tile, then sort each list)."""
    lanes: int
    tile_width: int
    tile_height: int
    chunks: int
    """pieces of the counting sorts (`ordered`)"""
    radix_bits: int
    """of the depth sort (`ordered`)"""
    scan_items: int
    fast_fma: bool

    @property
    def blend_items(self) -> int:
        """Work-items of a work-group of the blend stage; schedule/group.cl draws two pixels in each."""
        return 1 if self.schedule == "lanes" else self.tile_width * self.tile_height // 2


@dataclass(frozen=True)
class Source:
    """A flat kernel source with what the host must know of it."""

    text: str
    digest: str
    """SHA-256 of the text: the cache key."""
    record_bytes: int
    bounds_bytes: int


def assemble(features: FeatureSet, shape: DeviceShape) -> Source:
    """The source text of all stages for these features on a device of this shape."""
    effects = features.effects
    double = "blend_double" in features.names
    record_bytes = _record_bytes(effects, 8 if double else 4)
    bounds_bytes = BASE_BOUNDS_BYTES + 4 * sum(effect.bounds_lanes for effect in effects)
    defines = {
        "CHUNKS": shape.chunks,
        "FAST_FMA": int(shape.fast_fma),
        "LANES": shape.lanes,
        "RADIX_BITS": shape.radix_bits,
        "RECORD_BYTES": record_bytes,
        "SAMPLES": features.samples,
        "SCAN_ITEMS": shape.scan_items,
        "SETUP_FP64": int(features.setup_precision == "float64"),
        "TILE_H": shape.tile_height,
        "TILE_W": shape.tile_width,
    }
    if "color_sh" in features.names:
        defines["SH_DEGREE"] = features.sh_degree
    files = [effect.file for effect in effects]
    if shape.lists == "tiled":
        files.append("list/tiled.cl")
    sections = [sections_of(file) for file in files]

    def fill(match: re.Match[str]) -> str:
        return "".join(_HOOK.sub(fill, section.get(match[1], "")) for section in sections)

    stages = ["prelude", "math", "splat", "bounds", "project", *_LISTS[shape.lists], "blend"]
    stages = [f"{stage}.cl" for stage in (*stages, f"schedule/{shape.schedule}", "resolve")]
    body = "\n".join(_HOOK.sub(fill, kernel_text(stage)) for stage in stages)
    stages += [f"schedule/{schedule}.cl" for schedule in ("lanes", "group")]
    known = {hook for file in {*stages, *(one.file for one in CATALOGUE.values())} for hook in _hooks(file)}
    for file, section in zip(files, sections, strict=True):
        if unknown := set(section) - known:
            raise DeviceError(f"kernel file {file} fills hooks that no file has: {sorted(unknown)}")
    text = "".join(f"#define {name} {value}\n" for name, value in sorted(defines.items()))
    text += _BLANK.sub("\n", with_scalars(_COMMENT.sub("", body), double))
    return Source(text, hashlib.sha256(text.encode()).hexdigest(), record_bytes, bounds_bytes)


def with_scalars(text: str, double: bool = False) -> str:
    """Kernel text in which the type `wide` and its constants are those of C."""
    text = _WIDE_CONSTANT.sub(r"\1" if double else r"\1f", text)
    return _WIDE.sub("double" if double else "float", text)


def _record_bytes(effects: tuple[Effect, ...], scalar: int) -> int:
    """Size of the C struct `Splat` whose numbers take `scalar` bytes."""
    size = scalar * BASE_RECORD_LANES + 2 * BASE_RECORD_SHORTS
    for effect in effects:
        if effect.record_lanes:
            each = 4 if effect.record_whole else scalar
            size += -size % each + each * effect.record_lanes
    return size + -size % RECORD_ALIGNMENT


@cache
def kernel_text(path: str) -> str:
    """A file below kernels/opencl/, as it stands."""
    return (kernels_folder() / "opencl" / path).read_text(encoding="utf-8")


@cache
def _hooks(path: str) -> tuple[str, ...]:
    return tuple(_HOOK.findall(kernel_text(path)))


@cache
def sections_of(path: str) -> dict[str, str]:
    """The sections of an effect's file, by the hook that each fills."""
    pieces = _SECTION.split(kernel_text(path))
    return dict(zip(pieces[1::2], pieces[2::2], strict=True))
