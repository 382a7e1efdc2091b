"""Kernel source assembly: complete program texts, without #include, from a FeatureSet and a KernelConfig.

A frame needs two programs, `lists` and `frame`: drivers cache compiled programs by their text, and most
feature sets have the same `lists`. Gradients (`gradients`, `step`), `training` and `alignment` are
separate programs. An effect is a feature option: a camera model, compositing order, colour type or sensor
step, for example.

A line `//@@ name` in a stage's file is a hook: it is replaced by the sections `//@ name` of the chosen
effects' files, or by an empty line. `//@@ struct NAME`, `//@@ arguments KERNEL` and `//@@ passed KERNEL` (the
arguments of a call) are replaced by declarations of kernel_interface.py. `#line` directives give the file and
line of each line.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np

from fidsplat.backends import alignment
from fidsplat.backends.opencl.declare import (
    Argument,
    EffectCode,
    Member,
    Record,
    SampleBuffer,
    ScalarTypes,
    output_argument,
)
from fidsplat.backends.opencl.effect_code import EFFECT_CODE, extension_code
from fidsplat.backends.opencl.kernel_config import KernelConfig
from fidsplat.backends.opencl.kernel_interface import (
    BOUNDS,
    GROUP_KERNELS,
    KERNELS,
    RECORD_GRADIENT,
    SPLAT,
    UNCULLED_KERNELS,
    VIEW,
)
from fidsplat.effects import FeatureSet, Output
from fidsplat.effects.extensions import EXTENSIONS
from fidsplat.util.errors import DeviceError
from fidsplat.util.files import kernels_folder

_LIST_STAGES = {
    "sort_first": ("scan", "sort", "bin"),
    "bin_first": ("tile_lists",),
    "bin_local": ("tile_lists", "tile_lists_local"),
}
"""stages of the program `lists`, by tile-binning strategy"""
_FRAME_STAGES = (
    "prelude",
    "math",
    "splat",
    "bounds",
    "project",
    "pack",
    "blend",
    "schedule/{}_culling",
    "schedule/{}",
    "resolve",
)
"""stages of the program `frame`; `{}` is the schedule; `_culling`: culling of splats by cells or blocks of a
tile; `pack` is used by the strategy `sort_first` only"""
_GRADIENT_STAGES = (
    *("prelude", "math", "splat", "bounds", "record_gradients", "blend_backward"),
    *("schedule/{}_culling", "schedule/{}_backward", "project_splat_backward", "project_backward"),
)
_STEP_STAGES = (
    *("prelude", "math", "splat", "bounds", "record_gradients", "project_splat_backward"),
    *("train/activation_functions", "train/adam", "project_step"),
)
_REFINE_STAGES = "rigid_motion", "train/view_adam", "train/refine_view"
_TRAINING_STAGES = (
    "surface",
    "exposure",
    "activation_functions",
    "activate",
    "gather_rows",
    "position_noise",
)
_HOOK = re.compile(r"[ \t]*//@@ (\w+)(?: (\w+))?[ \t]*")
_HOOKS = re.compile(r"^[ \t]*//@@ (\w+)(?: \w+)?[ \t]*$", re.MULTILINE)
_COMMENT = re.compile(r"[ \t]*//.*")
_SECTION = re.compile(r"//@ (\w+)[ \t]*")
# the type `blend_real` and its constants (`ScalarTypes`); both patterns begin with a literal, which `re`
# finds 20 times as fast as a word boundary
_BLEND_CONSTANT = re.compile(r"BLEND_REAL\(([^()]+)\)")
_BLEND_REAL = re.compile(r"blend_real(?<=\bblend_real)\b")
_EFFECT_KERNELS = (
    *("project", "emit", "blend", "composite_background", "resolve"),
    *("blend_backward", "project_backward", "project_step"),
)
"""kernels to which effects add arguments: fields of `EffectCode`"""


@dataclass(frozen=True)
class ProgramSource:
    """OpenCL C source of a program."""

    listing: str
    """with comments, for reading"""
    text: str
    """without comments, as compiled; lines have the same numbers"""


@dataclass(eq=False)
class KernelSource:
    """Sources of programs, with their declarations for the host."""

    programs: dict[str, ProgramSource]
    records: dict[str, np.dtype]
    """structs of the texts, as NumPy types"""
    arguments: dict[str, dict[str, Argument]]
    """by kernel, then by the argument's name, in the order of the kernel's signature"""
    sample_buffers: tuple[SampleBuffer, ...]
    """sample buffers of the effects"""
    scalar_types: ScalarTypes

    @property
    def listing(self) -> str:
        """The text of all programs with comments."""
        return "".join(program.listing for program in self.programs.values())

    @property
    def text(self) -> str:
        """The compiled text of all programs, without comments."""
        return "".join(program.text for program in self.programs.values())

    @property
    def digest(self) -> str:
        """SHA-256 of the text: the cache key."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def __post_init__(self) -> None:
        self.uniform_groups: dict[str, dict[int, str]] = {}
        """kernel arguments by index, for each group of uniforms (`View.uniforms_of`)"""
        self.view_arrays: set[str] = set()
        """names of the arrays of the view (`View.array`) that kernels read"""
        self.cloud_arrays: list[str] = []
        """names of the arrays of the cloud that the projection reads"""
        for kernel, arguments in self.arguments.items():
            for argument in arguments.values():
                if argument.source == "uniform":
                    group, index = argument.uniform
                    self.uniform_groups.setdefault(group, {})[index] = argument.name
                elif argument.source == "array":
                    self.view_arrays.add(argument.name)
                elif argument.source == "cloud" and kernel == "project":
                    self.cloud_arrays.append(argument.name)


def effect_code_of(features: FeatureSet) -> dict[str, EffectCode]:
    """Code of all effects and of the parts that they require, by name, in the order in which they fill
    hooks."""
    chosen = [*features.effects, *features.outputs, *features.post_steps]
    for name in EXTENSIONS.keys() & {*chosen} - EFFECT_CODE.keys():
        code = extension_code(EXTENSIONS[name])
        _refuse_unknown_hooks(code.file)
        EFFECT_CODE[name] = code
    parts: set[str] = set()
    pending = chosen.copy()
    while pending:
        needed = list(EFFECT_CODE[pending.pop()].parts)
        for effect in chosen:
            for k, part in enumerate(needed):
                needed[k] = dict(EFFECT_CODE[part].replaced_by).get(effect, part)
        pending += set(needed) - parts
        parts.update(needed)
    names = (*features.effects, *sorted(parts), *features.outputs, *features.post_steps)
    return {name: EFFECT_CODE[name] for name in names}


def assemble(features: FeatureSet, config: KernelConfig) -> KernelSource:
    """Assemble the source of a feature set. Raises DeviceError if a file fills an unknown hook."""
    effects = effect_code_of(features)
    # blend and resolve are fused if a pixel has one sample and one pose, and no other kernel adds to it
    separate = {"rays", "shutter_exposure", "sub_frame_culling"}
    fused = features.samples == 1 and "background_constant" in effects and separate.isdisjoint(effects)
    files = [effect.file for effect in effects.values() if effect.file]
    files += _dialect(config, _scalar_types(features), features.effects)
    files += [*([f"part/resolve_fused_{config.schedule}.cl"] if fused else []), "part/resolve_pixel.cl"]
    if "blend_half" not in effects:
        files.append("part/blend_float.cl")
    if config.splats_per_item > 1 or config.culls_first:
        files += _frustum_parts(effects)
    if config.culls_first:
        files.append("part/unculled_splats.cl")
    if config.binning == "bin_first":
        files.append("list/tiled.cl")
    # depth keys per tile need bounds of a splat's depth in a tile, which only the pinhole has
    has_tile_keys = {"order_pixel", "camera_pinhole"} <= effects.keys() and config.binning != "sort_first"
    if has_tile_keys:
        effects["tile_keys"] = EFFECT_CODE["tile_keys"]
        files.append("part/tile_keys.cl")
    if "order_pixel" in effects:
        files.append(f"part/k_buffer_{config.schedule}.cl")
    elif config.schedule == "lanes":
        files.append("part/tile_loop_lanes.cl")
    if not effects.keys().isdisjoint({"order_pixel", "coplanar_layers"}):
        # several k-buffer passes over a tile's list; each needs a splat's minimum depth in the block or tile
        files += ["part/passes.cl", f"part/passes_{config.schedule}.cl"]
        files.append("part/blocks_nearest.cl" if config.schedule == "lanes" else "part/tile_nearest.cl")
    if "termination_depths" in effects:  # its sections follow those of part/passes_*.cl
        order = "_pixel" if "order_pixel" in effects else ""
        files += ["part/termination_depth_pixel.cl"] if order else []
        files.append(f"part/termination_depth{order}_{config.schedule}.cl")
    if "external_depth" in effects:  # its sections follow those of part/passes_*.cl
        files.append("part/external_depth_end.cl")
    stages = {
        "lists": (
            "prelude",
            "math",
            *(("splat",) if has_tile_keys else ()),
            "bounds",
            *_LIST_STAGES[config.binning],
        ),
        "frame": [
            stage.format(config.schedule)
            for stage in _FRAME_STAGES
            if not (stage == "pack" and config.binning != "sort_first") and not (stage == "resolve" and fused)
        ],
    }
    constants, kernels = build_constants(features, config), kernels_of(config)
    assembler = Assembler(
        _scalar_types(features), constants, files, effects.values(), features.images, fused, kernels
    )
    return assembler.source(stages)


def _frustum_parts(effects: Collection[str]) -> list[str]:
    """The file with the test of bounding spheres; none for cameras other than the pinhole, for disks with
    lowpass="none", for box splats, and for clouds with 3D Gaussians unless all are rendered by EWA."""
    if "camera_pinhole" not in effects:
        return []
    if "ellipsoids_only" in effects:
        return ["part/cull_frustum_ewa.cl"]
    if "thickness" in effects:
        return []
    if "lowpass_screen" in effects:
        return ["part/cull_frustum.cl"]
    return ["part/cull_frustum_pixel.cl"] if "lowpass_pixel" in effects else []


def culls_before_projection(features: FeatureSet) -> bool:
    """Whether groups of splats in Morton order can be culled by bounding spheres. Not with the k-buffer,
    which breaks ties by cloud order; nor with moving groups, where splats of a culling group may have
    different poses; nor where single splats are culled against the rows of a sub-frame instead."""
    effects = effect_code_of(features)
    excluded = {"order_pixel", "motion_groups", "sub_frame_culling"}
    return excluded.isdisjoint(effects) and bool(_frustum_parts(effects))


def assemble_gradients(features: FeatureSet, config: KernelConfig) -> KernelSource:
    return _assemble_backward("gradients", _GRADIENT_STAGES, features, config)


def assemble_step(features: FeatureSet, config: KernelConfig, refined: bool = False) -> KernelSource:
    """Assemble a training step: the last stage of the backward pass, fused with Adam. refined: also
    sum the gradient with respect to the camera, and refine views."""
    stages, parts = ((*_STEP_STAGES, *_REFINE_STAGES), ("step_camera",)) if refined else (_STEP_STAGES, ())
    return _assemble_backward("step", stages, features, config, parts)


def _assemble_backward(
    name: str, stages: Sequence[str], features: FeatureSet, config: KernelConfig, parts: Sequence[str] = ()
) -> KernelSource:
    effects = effect_code_of(features) | {part: EFFECT_CODE[part] for part in parts}
    # the backward pass needs the forward text of effects, but only the derivatives of outputs
    files = [effect.file for effect in effect_code_of(replace(features, outputs=(), post_steps=())).values()]
    files += _dialect(config, _scalar_types(features), features.effects)
    files += [effect.backward_file for effect in effects.values()]
    files += [EFFECT_CODE[part].file for part in parts]
    backward = {"BACKWARD_ITEMS": backward_items(features, config), "SEGMENT": segment_size(features, config)}
    if name == "step":
        backward["AXES"] = 3 if "thickness" in effects else 2
    constants = build_constants(features, config) | backward
    assembler = Assembler(
        _scalar_types(features), constants, files, effects.values(), kernels=kernels_of(config)
    )
    return assembler.source({name: [stage.format(config.schedule) for stage in stages]})


def _dialect(config: KernelConfig, scalar_types: ScalarTypes, effects: Iterable[str] = ()) -> list[str]:
    """Files with a vendor's instructions for float32 fragments: one for all frames, then the files of
    effects."""
    if not config.dialect or scalar_types.blend_real != "float":
        return []
    suffixes = {"arithmetic_approximate": "_exp", "blend_half": "_half"}
    return [
        f"dialect/{config.dialect}{suffix}.cl"
        for suffix in ("", *(suffixes[n] for n in effects if n in suffixes))
    ]


def kernels_of(config: KernelConfig) -> Mapping[str, tuple[Argument, ...]]:
    """The arguments of each kernel in the schedule of a config."""
    kernels = KERNELS | GROUP_KERNELS if config.schedule == "group" else KERNELS
    return kernels | UNCULLED_KERNELS if config.culls_first else kernels


@cache
def assemble_training(lanes: int, float64: bool, fast_fma: bool) -> KernelSource:
    """Assemble the kernels of loss, regularisation and optimiser, for vectors of `lanes` floats."""
    files = ("loss_values", "loss" if lanes == 1 else "loss_strips", *_TRAINING_STAGES)
    constants = {"LANES": lanes, "FAST_FMA": int(fast_fma and lanes > 1), "PROJECTION_FP64": int(float64)}
    scalar_types = ScalarTypes("double" if float64 else "float", "float")
    stages = ("prelude", "math", *(f"train/{file}" for file in files))
    return Assembler(scalar_types, constants).source({"training": stages})


@cache
def assemble_alignment(items: int) -> KernelSource:
    """Assemble the kernels of direct image alignment, for work-groups of `items` work-items."""
    constants: dict[str, int | str] = {"ITEMS": items, "FIRST_BIN": alignment.FIRST_BIN}
    for name in ("HUBER", "TUKEY", "MIN_NOISE", "MAX_NOISE"):
        constants[name] = f"{getattr(alignment, name)}f"
    return Assembler(ScalarTypes("float", "float"), constants).source({"alignment": ("alignment",)})


@cache
def assemble_alignment_step(float64: bool) -> KernelSource:
    """Assemble the kernels of steps of Levenberg-Marquardt, for views in float64 or float32."""
    constants = {
        **{"PROJECTION_FP64": int(float64), "STEP": f"({alignment.STEP})"},
        **{name: f"{getattr(alignment, name)}f" for name in ("MIN_GAIN", "MAX_GAIN")},
    }
    scalar_types = ScalarTypes("double" if float64 else "float", "float")
    return Assembler(scalar_types, constants).source(
        {"alignment": ("prelude", "rigid_motion", "alignment_step")}
    )


def assemble_test(file: str, config: KernelConfig, float64: bool, effects: Iterable[str] = ()) -> str:
    """Text of prelude.cl, math.cl and a file of test kernels below kernels/opencl/ (empty: no file). effects:
    files whose sections fill the hooks."""
    constants = {"LANES": config.lanes, "FAST_FMA": int(config.fast_fma), "PROJECTION_FP64": int(float64)}
    scalar_types = ScalarTypes("double" if float64 else "float", "float")
    stages = ("prelude", "math", *([file.removesuffix(".cl")] if file else ()))
    files = [*effects, *_dialect(config, scalar_types)]
    return Assembler(scalar_types, constants, files).source({"check": stages}).text


def backward_items(features: FeatureSet, config: KernelConfig) -> int:
    """Work-group size of the backward pass over a segment of a tile's list; half for outputs other than rgb,
    which would otherwise exceed NVIDIA's 48 KiB of local memory."""
    if config.schedule == "lanes":
        return 1
    return min(config.tile_width * config.tile_height, 128 if features.outputs else 256)


def segment_size(features: FeatureSet, config: KernelConfig) -> int:
    """Number of splats in a segment, the part of a tile's list that the backward pass evaluates at once; with
    the schedule `lanes` their minimum (`KernelConfig.tape`)."""
    if config.schedule == "lanes":
        return config.tape
    return backward_items(features, config) // config.tile_width


def _scalar_types(features: FeatureSet) -> ScalarTypes:
    real = "double" if features.projection_precision == "float64" else "float"
    return ScalarTypes(real, "double" if "blend_double" in features.effects else "float")


def build_constants(features: FeatureSet, config: KernelConfig) -> dict[str, int]:
    """The build constants, by their names in the kernels."""
    constants = {
        "SPLATS_PER_ITEM": config.splats_per_item,
        "SORT_BLOCKS": config.sort_blocks,
        "FAST_FMA": int(config.fast_fma),
        "LANES": config.lanes,
        "RADIX_BITS": config.radix_bits,
        "SAMPLES": features.samples,
        "SCAN_ITEMS": config.scan_items,
        "PROJECTION_FP64": int(features.projection_precision == "float64"),
        "SH_DEGREE": features.sh_degree,
        "TILE_H": config.tile_height,
        "TILE_W": config.tile_width,
        "K_BUFFER_SIZE": config.k_buffer_size,
    }
    if config.schedule == "group":
        constants["ROWS"] = config.rows
    return constants


class Assembler:
    """Assembles programs from stage files. Effects' files and the declarations of kernel_interface.py, merged
    with those of the effects, fill their hooks."""

    def __init__(
        self,
        scalar_types: ScalarTypes,
        defines: Mapping[str, int | str],
        files: Iterable[str] = (),
        effects: Iterable[EffectCode] = (),
        outputs: Sequence[Output] = (),
        fused: bool = False,
        kernels: Mapping[str, tuple[Argument, ...]] = KERNELS,
    ) -> None:
        """files: effect files below kernels/opencl/, in the order in which they fill a hook. fused: whether
        the blend kernel also resolves, with the arguments of both."""
        self._scalar_types, self._defines, self._effects = scalar_types, defines, list(effects)
        self._outputs, self._fused, self._kernels = outputs, fused, kernels
        self._sections = {file: sections_of(file) for file in files if file}
        self._sample_buffers: tuple[SampleBuffer, ...] = ()
        self._constants: dict[str, str] = {}
        """fields of `Splat` that all splats share, and their values"""
        self._packed: dict[str, str] = {}
        """packed fields of `Splat`, with the expressions that read them"""
        view, splat, bounds, record_gradient = VIEW, SPLAT, BOUNDS, RECORD_GRADIENT
        for effect in self._effects:
            self._sample_buffers += effect.sample_buffers
            self._constants |= dict(effect.constant)
            self._packed |= dict(effect.packed)
            view, splat = view.with_members(effect.view), splat.with_members(effect.splat)
            bounds = bounds.with_members(effect.bounds)
            record_gradient = record_gradient.with_members(effect.record_gradient)
        # as many padding fields as in `RecordGradient`
        record_alignment = record_gradient.alignment // 4 * scalar_types.dtype("real").itemsize
        fields = tuple(chain.from_iterable(member.names for member in record_gradient.members))
        totals = Record("Totals", (Member("real", fields, "of all tiles"),), record_alignment)
        splat = splat.without({**self._constants, **self._packed})
        self._structs = {record.name: record for record in (view, splat, bounds, record_gradient, totals)}
        self._used_structs: dict[str, np.dtype] = {}
        self._used_arguments: dict[str, dict[str, Argument]] = {}

    def source(self, programs: Mapping[str, Iterable[str]]) -> KernelSource:
        """Assemble programs from their stages, by the names of the programs."""
        texts = {name: self._program(name, stages) for name, stages in programs.items()}
        return KernelSource(
            texts, self._used_structs, self._used_arguments, self._sample_buffers, self._scalar_types
        )

    def _program(self, name: str, stages: Iterable[str]) -> ProgramSource:
        body = ""
        for stage in stages:
            body += self._expand(f"{stage}.cl", 1, lines_of(f"{stage}.cl"))
        body = self._with_values(body)
        bare = _COMMENT.sub("", body)
        head = ""
        for constant, value in sorted(self._defines.items()):
            if constant in bare:  # a constant that the text does not use must not change it
                head += f"#define {constant} {value}\n"
        return ProgramSource(f"// the program `{name}`\n{head}{body}", f"\n{head}{bare}")

    def _expand(self, file: str, first: int, lines: tuple[str, ...]) -> str:
        """Lines of a file from number `first`, with its hooks filled."""
        path = Path(file).name if Path(file).is_absolute() else f"opencl/{file}"
        text = f'#line {first} "{path}"\n'
        for number, line in enumerate(lines, first):
            hook = _HOOK.fullmatch(line) if "//@@" in line else None
            if hook is None:
                text += f"{line}\n"
                continue
            filled = self._declaration(hook[1], hook[2]) if hook[2] else ""
            for effect_file, sections in self._sections.items():
                for start, section in sections.get(hook[1], ()):
                    filled += self._expand(effect_file, start, section)
            text += f'{filled}#line {number + 1} "{path}"\n' if filled else "\n"
        return text

    def _declaration(self, kind: str, subject: str) -> str:
        """C for `//@@ struct NAME`, `//@@ arguments KERNEL` or `//@@ passed KERNEL`."""
        text = f'#line 1 "kernel_interface.py: {subject}"\n'
        if kind == "struct":
            record = self._structs[subject]
            self._used_structs[subject] = dtype = record.dtype(self._scalar_types)
            return text + record.text(dtype.itemsize)
        arguments = self._arguments(subject)
        if kind == "arguments":
            self._used_arguments[subject] = arguments
        for name, argument in arguments.items():
            comma = "," if name != next(reversed(arguments)) else ""
            if kind == "passed":
                text += f"        {name}{comma}\n"
            else:
                note = f"  // {argument.note}" if argument.note else ""
                text += f"    {argument.text}{comma}{note}\n"
        return text

    def _arguments(self, kernel: str) -> dict[str, Argument]:
        """A kernel's own arguments, then the arguments of effects in effect order, each name once."""
        merged = {argument.name: argument for argument in self._kernels[kernel]}
        field = "blend_backward" if kernel == "blend_checkpoints" else kernel
        for effect in self._effects if field in _EFFECT_KERNELS else ():
            for argument in getattr(effect, field):
                merged[argument.name] = argument
        if kernel in ("blend", "resolve"):
            access = "out" if kernel == "blend" else "in"
            for samples in self._sample_buffers:
                merged[samples.name] = Argument(samples.ctype, samples.name, access, note=samples.note)
        if kernel == "resolve":
            for output in self._outputs:
                argument = output_argument(output)
                merged[argument.name] = argument
        if kernel == "blend" and self._fused:
            for name, argument in self._arguments("resolve").items():
                if name != "stride":
                    merged.setdefault(name, argument)
            if GROUP_KERNELS.keys() <= self._kernels.keys():
                del merged["raw"]  # in registers (part/resolve_fused_group.cl)
        return merged

    def _with_values(self, text: str) -> str:
        """Replace the type `blend_real` and fields of `Splat` that are not stored as such in kernel text."""
        constants, packed, real = self._constants, self._packed, self._scalar_types.blend_real
        if constants:  # reads become the values; writes are removed
            names = "|".join(constants)
            text = re.sub(rf"\brecord\.(?:{names}) = [^;\n]*;", "", text)
            text = re.sub(rf"\bs(?:->|\.)({names})\b", lambda read: constants[read[1]], text)
        if packed:  # reads become the expression, with the record in place of `{}`
            names = "|".join(packed)
            text = re.sub(rf"\brecord\.({names})\b", r"unpacked_\1", text)
            text = re.sub(rf"\b(s(?:->|\.))({names})\b", lambda read: packed[read[2]].format(read[1]), text)
        return _BLEND_REAL.sub(real, _BLEND_CONSTANT.sub(r"\1" if real == "double" else r"\1f", text))


def _refuse_unknown_hooks(file: str) -> None:
    """Raise DeviceError if a file fills a hook that no kernel file has."""
    known: set[str] = set()
    for path in (kernels_folder() / "opencl").rglob("*.cl"):
        known.update(_HOOKS.findall(path.read_text(encoding="utf-8")))
    if unknown := sections_of(file).keys() - known:
        raise DeviceError(f"hooks filled by {file} must exist, got {sorted(unknown)}; correct their names")


def kernel_text(path: str) -> str:
    """The text of a file below kernels/opencl/."""
    return "\n".join(lines_of(path)) + "\n"


@cache
def lines_of(path: str) -> tuple[str, ...]:
    """The lines of a file below kernels/opencl/."""
    return tuple((kernels_folder() / "opencl" / path).read_text(encoding="utf-8").splitlines())


@cache
def sections_of(path: str) -> dict[str, list[tuple[int, tuple[str, ...]]]]:
    """The sections of an effect's file, by the hook that each fills: number of the first line, and lines."""
    sections: dict[str, list[tuple[int, tuple[str, ...]]]] = {}
    lines, end = lines_of(path), len(lines_of(path))
    for number in range(end - 1, -1, -1):
        if match := _SECTION.fullmatch(lines[number]):
            sections.setdefault(match[1], []).insert(0, (number + 2, lines[number + 1 : end]))
            end = number
    return sections
