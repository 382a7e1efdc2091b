"""The text of the programs `gradients` and `step`: put together as assemble.py does, when they are asked for.

What only draws never has it: the programs `lists` and `picture` are the same with derivatives and without.
"""

from __future__ import annotations

from collections.abc import Sequence

from fidsplat.backends.opencl.assemble import (
    Declarations,
    Source,
    Writer,
    kernels_in,
    layouts_of,
    numbers_of,
)
from fidsplat.backends.opencl.declare import Argument, Record, member
from fidsplat.backends.opencl.effect_layouts import LAYOUTS as DRAWN
from fidsplat.backends.opencl.gradients_layout import GROUP_KERNELS, KERNELS, LAYOUTS, MOMENTS, BackwardLayout
from fidsplat.backends.opencl.shapes import DeviceShape
from fidsplat.effects import FeatureSet

_STAGES = (
    "prelude",
    "math",
    "splat",
    "bounds",
    "moments",
    "blend_backward",
    "schedule/{}_cells",
    "schedule/{}_backward",
    "set_up_backward",
    "project_backward",
)
_STEP_STAGES = (
    "prelude",
    "math",
    "splat",
    "bounds",
    "moments",
    "set_up_backward",
    "train/activation_functions",
    "train/adam",
    "project_step",
)


def assemble_gradients(features: FeatureSet, shape: DeviceShape) -> Source:
    """The source of the derivatives of these features on a device of this shape."""
    return _assembled("gradients", _STAGES, features, shape)


def assemble_step(features: FeatureSet, shape: DeviceShape) -> Source:
    """The source of a training's step by them, which takes the place of the last of their stages."""
    return _assembled("step", _STEP_STAGES, features, shape)


def _assembled(name: str, stages: Sequence[str], features: FeatureSet, shape: DeviceShape) -> Source:
    layouts = [LAYOUTS[name] for name in layouts_of(features) if name in LAYOUTS]
    declared = _Declarations(
        features, layouts, KERNELS | GROUP_KERNELS if shape.schedule == "group" else KERNELS
    )
    # of what is drawn the ways of drawing are needed again, of outputs only their derivatives
    slots = (name for slot in features.slots for name in (slot, *DRAWN[slot].parts))
    files = [DRAWN[name].file for name in dict.fromkeys(slots)]
    files += [layout.file for layout in layouts]
    numbers = numbers_of(features, shape) | {
        "BACK_ITEMS": group_of(features, shape),
        "CHUNK": chunk_of(features, shape),
    }
    writer = Writer([file for file in files if file], declared, numbers)
    text = writer.program(name, [stage.format(shape.schedule) for stage in stages])
    arguments = {kernel: declared.arguments(kernel) for kernel in kernels_in(text)}
    return Source({name: text}, declared.records, arguments, (), declared.scalars)


def chunk_of(features: FeatureSet, shape: DeviceShape) -> int:
    """Splats of a tile's list that are walked forward and then back: on GPUs a column of a splat's pixels for
    each work-item, on CPUs at least, where they touch all of a tile."""
    if shape.schedule == "lanes":
        return shape.tape
    return group_of(features, shape) // shape.tile_width


def tape_bytes(features: FeatureSet, shape: DeviceShape) -> int:
    """Of the record `Tape` (schedule/lanes_backward.cl): light and opacity of each pixel of so many splats,
    two words of each of eight times as many, a word of its own, all in whole vectors."""
    chunk, vector = chunk_of(features, shape), 4 * shape.lanes
    words = 2 * 8 * chunk + 1
    return 8 * chunk * shape.tile_width * shape.tile_height + -(-4 * words // vector) * vector


def group_of(features: FeatureSet, shape: DeviceShape) -> int:
    """Work-items that take a chunk of a tile's list back. Half as many where outputs beside rgb keep more of
    pixels: with distortion's, 256 would not fit into the 48 KiB of local memory that NVIDIA's OpenCL has."""
    if shape.schedule == "lanes":
        return 1
    return min(shape.tile_width * shape.tile_height, 128 if features.outputs else 256)


class _Declarations(Declarations):
    """What gradients_layout.py declares beside the records of the picture."""

    def __init__(
        self, features: FeatureSet, layouts: list[BackwardLayout], kernels: dict[str, tuple[Argument, ...]]
    ) -> None:
        super().__init__(layouts_of(features), features)
        self._backward, self._kernels = layouts, kernels
        moments = MOMENTS.with_members(one for layout in layouts for one in layout.moments)
        names = [name for one in moments.members for name, _ in one.names]
        # with as many fields of padding
        alignment = moments.alignment // 4 * self.scalars.dtype("real").itemsize
        totals = Record("Totals", (member(f"real {' '.join(names)}", "of all tiles"),), alignment)
        self.add(moments, totals)

    def arguments(self, kernel: str) -> tuple[Argument, ...]:
        """Its own, then those of the effects in their order."""
        added: list[Argument] = []
        if kernel in ("blend_light", "blend_backward", "project_backward"):
            stage = "blend_backward" if kernel == "blend_light" else kernel
            added += (one for layout in self._backward for one in getattr(layout, stage))
        return (*self._kernels[kernel], *added)
