"""Frames with derivatives: the stages of frame.py, and the kernels of the program `gradients`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from copy import copy
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from fidsplat.backends.gradients import (
    NOT_THE_LAST,
    DifferentiableImages,
    TooLittleRoom,
    check_shape,
    gradient_shape,
)
from fidsplat.backends.interface import GradientPipeline
from fidsplat.backends.opencl.assemble import (
    assemble_gradients,
    assemble_step,
    backward_chunk,
    backward_items,
)
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.gradients_again import Again
from fidsplat.backends.opencl.images import OpenCLImages
from fidsplat.backends.opencl.pipeline import OpenCLPipeline
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.view import View
from fidsplat.effects import IMAGES
from fidsplat.effects.differentiable import GRADIENT_OUTPUTS, check_gradients
from fidsplat.util.errors import DeviceError, InputError

_GROUP = 64  # RESERVE_ITEMS, POSE_ITEMS, SUM_ITEMS and STEP_ITEMS of the kernels
_F32 = np.dtype(np.float32)
_ZERO = np.zeros(1, np.uint32)  # of floats too


class OpenCLDifferentiable(DifferentiableImages):
    """Output images of `OpenCLGradients.forward`."""

    picture: DeviceFrame
    images: OpenCLImages

    def device_array(self, name: str) -> Array:
        """The image as an array of the device, (h, w) or (h, w, channels); no copy."""
        buffer, shape = self.device_buffer(name)
        return Array(self.picture.queue, shape, np.dtype(IMAGES[name].dtype), data=buffer)

    def device_buffer(self, name: str) -> tuple[cl.Buffer, tuple[int, ...]]:
        """The image's buffer and shape: an array takes the host longer to make than a kernel to launch."""
        return self.picture.named[f"{name}_out"], gradient_shape(name, self.picture.view)


@contextmanager
def _failing(picture: DeviceFrame) -> Iterator[None]:
    """Takes the device for oneself, and says what it fails at."""
    try:
        with picture.workspace.lock:
            yield
    except cl.Error as error:
        title = picture.workspace.info.title
        raise DeviceError(f"{title} failed while taking derivatives: {error}") from error


class TakenBack:
    """A frame whose gradients are summed per tile, until the device renders another one."""

    def __init__(self, of: OpenCLGradients, images: OpenCLDifferentiable, picture: DeviceFrame) -> None:
        self._of, self._images, self._picture = of, images, picture

    def gradients(self) -> dict[str, Any]:
        """The result of `GradientPipeline.backward`."""
        with self._last():
            return self._of.sum_up(self._picture)

    def prepare_step(self) -> None:
        """Before `step`: compiles what it launches."""
        self._of.prepare_step()

    def step(self, given: Mapping[str, Any]) -> None:
        """Launches kernels/opencl/project_step.cl. given: its arguments but for the picture's."""
        with self._last():
            self._of.step(self._picture, given)

    def _last(self) -> AbstractContextManager[None]:
        if not self._images.last:
            raise InputError(NOT_THE_LAST)
        return _failing(self._picture)


class OpenCLGradients(GradientPipeline):
    """Compiled stages and their derivatives."""

    def __init__(self, pipeline: OpenCLPipeline) -> None:
        self._pipeline = pipeline
        self.source = assemble_gradients(pipeline.features, pipeline.shape)
        self.program = Program(pipeline.workspace, self.source)
        arguments = self.source.arguments
        self._wanted = {one.name for one in arguments["blend_backward"]}
        self._cloud_arrays = [one.name for one in arguments["project_backward"] if one.source == "cloud"]
        self._pairs = 0
        """for which there is room"""
        self._commands = CommandList(self.program)
        """of `sum_up`"""
        self._again = Again(pipeline.workspace, pipeline.program, self.program)
        self._step: tuple[int, CommandList] | None = None
        """number of splats, and what was launched for so many"""

    def forward(self, resident: Resident, view: View, waits: bool = True) -> OpenCLDifferentiable:
        """Render one view; GPUs need not wait where frames were differentiated before."""
        pipeline, again = self._pipeline, self._again
        with pipeline.workspace.rendering():
            if waits or not self._pairs:
                frame = pipeline.render_complete(resident, view)
            elif (frame := again.draw(resident, view, self._pairs)) is None:
                frame = pipeline.render_complete(resident, view, self._pairs, again.record())
                again.keep(frame)
            return OpenCLDifferentiable(frame, pipeline.images_of(frame))

    def backward(self, images: OpenCLDifferentiable, gradients: Mapping[str, Any]) -> dict[str, Any]:
        """Gradients as pyopencl arrays."""
        with images.picture.workspace.lock:
            return self.take_back(images, gradients).gradients()

    def take_back(self, images: OpenCLDifferentiable, gradients: Mapping[str, Any]) -> TakenBack:
        """`backward` up to the sums over tiles."""
        check_gradients(self._pipeline.features, gradients)
        if not images.last:
            raise InputError(NOT_THE_LAST)
        picture = images.picture
        with _failing(picture):
            return TakenBack(self, images, self._backward(picture, gradients))

    def _backward(self, drawn: DeviceFrame, gradients: Mapping[str, Any]) -> DeviceFrame:
        if drawn.counted is not None and self._again.take_back(drawn, gradients, lambda: self._ask(drawn)):
            return self._with_slots(drawn)
        picture = self._with_slots(drawn)
        picture.commands = self._again.record_back()
        view, shape, count = picture.view, self._pipeline.shape, picture.resident.count
        self._take_gradients(picture, gradients)
        tile = shape.tile_width * shape.tile_height
        features, in_groups = self._pipeline.features, shape.schedule == "group"
        chunks = picture.pairs // backward_chunk(features, shape) + picture.tiles
        picture.take("checkpoints", (8 * tile if in_groups else 4 * (tile + shape.lanes)) * chunks)
        reserved = picture.take("reserved", 8)
        if not in_groups:
            rows = -(-view.height // shape.tile_height)
            picture.take("big_rows", 4 * picture.numbers["big_capacity"] * rows)

        cl.enqueue_fill_buffer(picture.queue, reserved, _ZERO, 0, 8)
        if count:
            picture.launch("reserve", "reserve_slots", count, _GROUP, count=count)
        ceiling = math.log(view.ceiling)
        groups = chunks if in_groups else min(picture.tiles, picture.workspace.info.compute_units)
        if in_groups:
            picture.take("reached", 4 * picture.tiles)
            picture.take("chunk_tiles", 4 * chunks)
            items = shape.blend_items
            picture.launch("blend backward", "blend_light", picture.tiles * items, items, log_ceiling=ceiling)
        else:
            picture.take("tapes", self._tape_bytes() * groups)
        items = backward_items(features, shape)
        picture.launch("blend backward", "blend_backward", groups * items, items, log_ceiling=ceiling)
        self._ask(drawn)
        if drawn.counted is not None:
            wanted = {f"by_{name}" for name in GRADIENT_OUTPUTS} & self._wanted
            self._again.keep_back(picture, gradients, wanted)
        return picture

    def _tape_bytes(self) -> int:
        """Size of the record `Tape` (schedule/lanes_backward.cl): light and opacity of each pixel for a
        chunk's splats, two words for each of eight times as many splats, one more word; in whole vectors."""
        shape = self._pipeline.shape
        chunk, vector = backward_chunk(self._pipeline.features, shape), 4 * shape.lanes
        words = 2 * 8 * chunk + 1
        return 8 * chunk * shape.tile_width * shape.tile_height + -(-4 * words // vector) * vector

    def _with_slots(self, drawn: DeviceFrame) -> DeviceFrame:
        """The picture with the kernels of the way back, and what those leave that go through tiles."""
        picture = copy(drawn)
        picture.commands = self._commands
        picture.take("splat_slots", 4 * picture.resident.count)
        picture.take("moments", self.source.records["Moments"].itemsize * picture.pairs)
        picture.take("tile_sums", 3 * self.source.scalars.dtype("real").itemsize * picture.tiles)
        return picture

    def sum_up(self, picture: DeviceFrame) -> dict[str, Any]:
        """The derivatives of a picture that was taken back."""
        picture = copy(picture)
        picture.commands = self._commands
        self._commands.clear()
        count, real = picture.resident.count, self.source.scalars.dtype("real").itemsize
        posed = -(-count // _GROUP)  # work-groups that sum up the pose
        picture.take("group_sums", 6 * real * posed)
        found = self._room_for_results(picture)
        if count:
            arrays: dict[str, Any] = {
                name: picture.resident.part(name, 0, count) for name in self._cloud_arrays
            }
            picture.launch("project backward", "project_backward", count, _GROUP, count=count, **arrays)
        given: dict[str, Any] = {name: found[name].data for name in ("background", "pose")}
        given |= {"tiles": picture.tiles, "groups": posed}
        picture.launch("project backward", "add_up", (3 + 6) * _GROUP, _GROUP, **given)
        return found

    def prepare_step(self) -> None:
        """Compiles what `step` launches, which those do not need who only ask for derivatives."""
        if self._step is None:
            source = assemble_step(self._pipeline.features, self._pipeline.shape)
            self._step = 0, CommandList(Program(self._pipeline.workspace, source))

    def step(self, picture: DeviceFrame, given: Mapping[str, Any]) -> None:
        """The step of a training by a picture that was taken back, with arguments that are its own."""
        assert self._step is not None  # `prepare_step`
        known, commands = self._step
        count = picture.resident.count
        arguments = commands.program.source.arguments["project_step"]
        every = {**given, "count": count}
        values = {one.name: every[one.name] if one.name in every else picture.value(one) for one in arguments}
        if known != count:
            self._step = 0, commands  # an interrupt on the way leaves none
            commands.clear()
            size = (max(1, -(-count // _GROUP)) * _GROUP,)
            commands.record("project_step", size, (_GROUP,), list(values.values()))
            self._step = count, commands
        commands.set(values)
        (event,) = commands.submit(picture.queue)
        picture.events.append(("project backward", event))

    def _ask(self, drawn: DeviceFrame) -> None:
        """Whether there was room for all pairs: with too little of it lists were left empty, and splats have
        slots beyond the end. The device is busy meanwhile."""
        if (pairs := drawn.count_pairs()) is None:
            raise TooLittleRoom
        if self._pairs < pairs * 9 // 8:  # seldom: with another number nothing is launched as before
            self._pairs = pairs * 5 // 4

    def _take_gradients(self, picture: DeviceFrame, gradients: Mapping[str, Any]) -> None:
        """The derivatives by the images, as arguments of the kernels."""
        for name in GRADIENT_OUTPUTS:
            if f"by_{name}" not in self._wanted:
                continue
            shape, given = gradient_shape(name, picture.view), gradients.get(name)
            if given is None:
                size = 4 * math.prod(shape)
                buffer = picture.take(f"by_{name}", size)
                cl.enqueue_fill_buffer(picture.queue, buffer, _ZERO, 0, size)
                continue
            check_shape(name, given.shape, picture.view)
            if isinstance(given, Array):
                if given.dtype != _F32 or not given.flags.c_contiguous or given.offset:
                    raise InputError(f"the gradient of {name} must be a whole, contiguous float32 array")
                picture.bind(f"by_{name}", given.data)  # pyright: ignore[reportArgumentType]
            else:
                picture.put(f"by_{name}", np.ascontiguousarray(given, np.float32))

    def _room_for_results(self, picture: DeviceFrame) -> dict[str, Array]:
        """Arrays for the results, the same from call to call."""
        count, features = picture.resident.count, self._pipeline.features
        shapes: dict[str, tuple[int, ...]] = {
            **{"means": (count, 3), "quats": (count, 4), "scales": (count, 2), "opacities": (count,)},
            **{"screen": (count,), "background": (3,), "pose": (6,)},
        }
        if "color_sh" in features.slots:
            shapes["sh"] = (count, (features.sh_degree + 1) ** 2, 3)
        else:
            shapes["colors"] = (count, 3)
        found = {}
        for name, shape in shapes.items():
            argument = name if name == "screen" else f"by_{name}"
            found[name] = picture.pool.array(picture.queue, argument, shape)
            picture.named[argument] = found[name].data  # pyright: ignore[reportArgumentType]
        return found
