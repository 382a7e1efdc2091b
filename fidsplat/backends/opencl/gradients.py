"""Differentiable frames: the stages of frame.py, then the backward kernels of the program `gradients`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from fidsplat.backends.gradients import (
    NOT_LATEST_FRAME,
    CapacityExceeded,
    DifferentiableImages,
    check_shape,
    gradient_shape,
)
from fidsplat.backends.interface import GradientPipeline
from fidsplat.backends.opencl.assemble import (
    assemble_gradients,
    assemble_step,
    backward_items,
    segment_size,
)
from fidsplat.backends.opencl.buffers import DeviceRecord
from fidsplat.backends.opencl.cloud import OpenCLCloud
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.declare import Argument
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.images import OpenCLImages
from fidsplat.backends.opencl.pipeline import OpenCLPipeline
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.uniforms import scalar_arguments
from fidsplat.backends.view import View
from fidsplat.effects import IMAGES
from fidsplat.effects.differentiable import GRADIENT_OUTPUTS, check_gradients
from fidsplat.util.errors import InputError

_GROUP = 64  # work-group size: RESERVE_ITEMS, POSE_ITEMS, SUM_ITEMS and STEP_ITEMS of the kernels
_SUMS = {"background": 3, "pose": 6, "intrinsics": 4}
"""gradients that are sums over tiles or splats, and their number of components"""
_CAMERA_SUMS = 10  # pose and intrinsics
_REFINE_ITEMS = 240  # of kernels/opencl/train/refine_view.cl
_ERROR_CONTEXT = "taking derivatives"
_F32 = np.dtype(np.float32)
_ZERO = np.zeros(1, np.uint32)  # also zeroes floats


class OpenCLDifferentiable(DifferentiableImages):
    frame: DeviceFrame
    images: OpenCLImages

    def device_array(self, name: str) -> Array:
        """The image as a pyopencl array, (h, w) or (h, w, channels), without a copy."""
        buffer, shape = self.device_buffer(name)
        return Array(self.frame.queue, shape, np.dtype(IMAGES[name].dtype), data=buffer)

    def device_buffer(self, name: str) -> tuple[cl.Buffer, tuple[int, ...]]:
        """The buffer of an image, and its shape; faster than making an array."""
        return self.frame.named[f"{name}_out"], gradient_shape(name, self.frame.view)


class OpenCLGradients(GradientPipeline):
    """Compiled stages with their gradients. Frames of a training run differ only in numeric arguments, so
    their command lists are replayed. The backward pass is replayed only with the same buffers."""

    def __init__(self, pipeline: OpenCLPipeline) -> None:
        self._pipeline, self.features = pipeline, pipeline.features
        self.source = assemble_gradients(pipeline.features, pipeline.config)
        self.program = Program(pipeline.workspace, self.source)
        arguments = self.source.arguments
        self._output_gradients = [
            name for name in GRADIENT_OUTPUTS if f"grad_{name}" in arguments["blend_backward"]
        ]
        self.cloud_arrays = [
            name for name, argument in arguments["project_backward"].items() if argument.source == "cloud"
        ]
        self._pair_limit = 0
        """capacity of the tile lists of frames that are submitted without waiting for their counts"""
        self._tile_commands, self.sum_commands = CommandList(self.program), CommandList(self.program)
        self.step_commands: dict[bool, CommandList] = {}
        """command lists of `TileGradients.step`, without and with refinement of views"""
        self.frame_arguments: dict[bool, dict[str, Argument]] = {}
        """arguments of the step kernels whose values come from the frame"""

    def forward(self, cloud: OpenCLCloud, view: View, waits: bool = True) -> OpenCLDifferentiable:
        """Render one frame. waits: whether to wait for its counts, as the first frame on a GPU must."""
        pipeline = self._pipeline
        with pipeline.workspace.lock:
            if waits or not self._pair_limit:
                frame = pipeline.render_undivided(cloud, view)
            else:
                frame = pipeline.replay_undivided(cloud, view, self._pair_limit)
            return OpenCLDifferentiable(frame, pipeline.images_of(frame))

    def backward(self, images: OpenCLDifferentiable, gradients: Mapping[str, Any]) -> dict[str, Any]:
        with images.frame.workspace.lock:
            return self.backward_per_tile(images, gradients).gradients()

    def backward_per_tile(self, images: OpenCLDifferentiable, gradients: Mapping[str, Any]) -> TileGradients:
        check_gradients(self.features, gradients)
        if not images.is_latest:
            raise InputError(NOT_LATEST_FRAME)
        with images.frame.workspace.lock, images.frame.workspace.device_errors(_ERROR_CONTEXT):
            frame = self._backward_frame(images.frame)
            self._submit_blend_backward(frame, gradients)
            return TileGradients(self, images, frame)

    def _backward_frame(self, forward: DeviceFrame) -> DeviceFrame:
        """A copy of the frame that launches kernels of the program `gradients` and has their buffers."""
        frame = copy(forward)
        frame.commands, frame.source = self._tile_commands, self.source
        frame.scratch("gradient_offsets", 4 * frame.cloud.count)
        frame.scratch("record_gradients", self.source.records["RecordGradient"].itemsize * frame.pairs)
        frame.scratch("background_sums", 3 * self.source.scalar_types.dtype("real").itemsize * frame.tiles)
        return frame

    def _submit_blend_backward(self, frame: DeviceFrame, gradients: Mapping[str, Any]) -> None:
        """Submit the kernels up to the sums over tiles; replays their command list if possible."""
        self._bind_gradients(frame, gradients)
        reserved = frame.scratch("reserved", 8)
        cl.enqueue_fill_buffer(frame.queue, reserved, _ZERO, 0, 8)
        ceiling = math.log(frame.view.opacity_ceiling)
        commands, key = self._tile_commands, self._key(frame)
        if key is not None and commands.key == key:
            values = {f"grad_{name}": frame.named[f"grad_{name}"] for name in self._output_gradients}
            scalars = scalar_arguments(frame.view, self.source)
            commands.set({**scalars, "log_ceiling": ceiling, **frame.acquired, **values})
            frame.events += commands.submit(frame.queue)
            frame.stages += commands.stages
            self._check_capacity(frame)
            return
        commands.clear()
        self._record_blend_backward(frame, ceiling)
        self._check_capacity(frame)
        commands.key = self._key(frame)

    def _key(self, frame: DeviceFrame) -> Any:
        """Key of the backward pass's command list: its buffers; None if the host waited for the counts."""
        if frame.counted is None:
            return None
        count, size = frame.cloud.count, (frame.view.width, frame.view.height)
        return frame.pool.generation, count, frame.capacity, size

    def _record_blend_backward(self, frame: DeviceFrame, log_ceiling: float) -> None:
        features, config = self.features, self._pipeline.config
        in_groups, tile = config.schedule == "group", config.tile_width * config.tile_height
        segments = frame.pairs // segment_size(features, config) + frame.tiles
        frame.scratch("checkpoints", (8 * tile if in_groups else 4 * (tile + config.lanes)) * segments)
        if not in_groups:
            rows = -(-frame.view.height // config.tile_height)
            frame.scratch("big_rows", 4 * frame.scalars["big_capacity"] * rows)
        if count := frame.cloud.count:
            frame.launch("reserve", "reserve_gradients", (count,), (_GROUP,), count=count)
        groups = segments if in_groups else min(frame.tiles, frame.workspace.info.compute_units)
        if in_groups:
            frame.scratch("reached_segments", 4 * frame.tiles)
            frame.scratch("segment_tiles", 4 * segments)
            size = frame.tiles * config.blend_items
            frame.launch(
                "blend backward", "blend_checkpoints", (size,), (config.blend_items,), log_ceiling=log_ceiling
            )
        else:
            frame.scratch("tapes", self._tape_bytes() * groups)
        items = backward_items(features, config)
        frame.launch("blend backward", "blend_backward", (groups * items,), (items,), log_ceiling=log_ceiling)

    def _tape_bytes(self) -> int:
        """Bytes of the struct `Tape` (schedule/lanes_backward.cl): per pixel and splat of the shortest
        segment, transmittance and alpha; then two words for each splat of the longest segment, which has 8
        times as many (TAPE_SPLATS), and one more, rounded up to vectors."""
        config = self._pipeline.config
        splats, vector = segment_size(self.features, config), 4 * config.lanes
        words = 2 * 8 * splats + 1
        return 8 * splats * config.tile_width * config.tile_height + -(-4 * words // vector) * vector

    def compile_step(self, refined: bool = False) -> None:
        """Compile the kernels of `step`, which gradients do not need. refined: whether views are refined."""
        if refined not in self.step_commands:
            source = assemble_step(self.features, self._pipeline.config, refined)
            self.step_commands[refined] = CommandList(Program(self._pipeline.workspace, source))

    def _check_capacity(self, frame: DeviceFrame) -> None:
        """Raise CapacityExceeded if the lists were too small."""
        if (pairs := frame.count_pairs()) is None:
            raise CapacityExceeded
        # change the limit seldom, as frames with another limit are recorded again
        if self._pair_limit < pairs * 9 // 8:
            self._pair_limit = pairs * 5 // 4

    def _bind_gradients(self, frame: DeviceFrame, gradients: Mapping[str, Any]) -> None:
        """Bind the gradients with respect to the outputs as kernel arguments."""
        for name in self._output_gradients:
            shape, gradient = gradient_shape(name, frame.view), gradients.get(name)
            if gradient is None:
                size = 4 * math.prod(shape)
                buffer = frame.scratch(f"grad_{name}", size)
                cl.enqueue_fill_buffer(frame.queue, buffer, _ZERO, 0, size)
                continue
            check_shape(name, gradient.shape, frame.view)
            if isinstance(gradient, Array):
                if gradient.dtype != _F32 or not gradient.flags.c_contiguous or gradient.offset:
                    raise InputError(
                        f"the gradient of {name} must be a complete, contiguous float32 array, got "
                        f"{gradient.dtype} at offset {gradient.offset}; copy it first"
                    )
                frame.named[f"grad_{name}"] = gradient.data  # pyright: ignore[reportArgumentType]
            else:
                frame.upload(f"grad_{name}", np.ascontiguousarray(gradient, np.float32))


class TileGradients:
    """Gradients of a frame summed per tile, valid until the device renders another frame."""

    def __init__(self, pipeline: OpenCLGradients, images: OpenCLDifferentiable, frame: DeviceFrame) -> None:
        self.pipeline, self._images, self._frame = pipeline, images, frame

    def gradients(self) -> dict[str, Any]:
        """The result of `OpenCLGradients.backward`, from the sums over tiles."""
        pipeline = self.pipeline
        with self._latest_frame():
            frame = copy(self._frame)
            frame.commands = pipeline.sum_commands
            frame.commands.clear()
            count, groups = frame.cloud.count, self._allocate_camera_sums(frame)
            results = self._allocate_results(frame)
            if count:
                arrays: dict[str, Any] = {
                    name: frame.cloud.array_in_cloud_order(name, 0, count) for name in pipeline.cloud_arrays
                }
                frame.launch(
                    "project backward", "project_backward", (count,), (_GROUP,), count=count, **arrays
                )
            self._sum_gradients(frame, results, groups)
            return results

    def step(
        self,
        arguments: Mapping[str, Any],
        constants: Mapping[str, Any],
        version: object,
        next_record: DeviceRecord | None = None,
    ) -> None:
        """Submit an optimiser step (kernels/opencl/project_step.cl), compiled by
        `OpenCLGradients.compile_step`.

        Args:
            arguments: values that the frame does not define.
            constants: further values, which are equal in all steps with the same `version`.
            next_record: record of the next frame's camera, if views are refined
                (kernels/opencl/train/refine_view.cl).
        """
        with self._latest_frame():
            refined = next_record is not None
            frame, commands = self._frame, self.pipeline.step_commands[refined]
            arguments = {**arguments, "count": (count := frame.cloud.count)}
            if refined:
                arguments["groups"] = self._allocate_camera_sums(frame)
            declared, key = commands.program.source.arguments, (count, version)
            kernels = ("project_step", "refine_view") if refined else ("project_step",)
            if commands.key != key:
                commands.clear()
                self.pipeline.frame_arguments[refined] = {
                    name: argument
                    for kernel in kernels
                    for name, argument in declared[kernel].items()
                    if name not in arguments and name not in constants
                }
            for name, argument in self.pipeline.frame_arguments[refined].items():
                arguments[name] = frame.argument_value(argument)
            if commands.key != key:
                values, groups = {**constants, **arguments}, max(1, -(-count // _GROUP))
                for kernel, size, group in zip(
                    kernels, (groups * _GROUP, _REFINE_ITEMS), (_GROUP, _REFINE_ITEMS), strict=False
                ):
                    commands.record(kernel, (size,), (group,), [values[name] for name in declared[kernel]])
                commands.key = key
            commands.set(arguments)
            frame.events += commands.submit(frame.queue)
            frame.stages += ["project backward"] * len(kernels)
            if next_record is not None:
                frame.pool.set_contents("view", next_record)

    @contextmanager
    def _latest_frame(self) -> Iterator[None]:
        """Lock the device. Raises InputError if it has rendered another frame since."""
        if not self._images.is_latest:
            raise InputError(NOT_LATEST_FRAME)
        with self._frame.workspace.lock, self._frame.workspace.device_errors(_ERROR_CONTEXT):
            yield

    def _allocate_camera_sums(self, frame: DeviceFrame) -> int:
        """Allocate the sums of work-groups for the camera, and return the number of work-groups."""
        groups = -(-frame.cloud.count // _GROUP)
        real = self.pipeline.source.scalar_types.dtype("real").itemsize
        frame.scratch("camera_sums", _CAMERA_SUMS * real * groups)
        return groups

    def _sum_gradients(self, frame: DeviceFrame, results: Mapping[str, Array], groups: int) -> None:
        """Sum the gradients of the background over tiles, and those of the camera over work-groups."""
        arguments: dict[str, Any] = {name: results[name].data for name in _SUMS}
        arguments |= {"tiles": frame.tiles, "groups": groups}
        frame.launch(
            "project backward", "sum_gradients", (sum(_SUMS.values()) * _GROUP,), (_GROUP,), **arguments
        )

    def _allocate_results(self, frame: DeviceFrame) -> dict[str, Array]:
        """Arrays for the gradients, reused by every call."""
        count, features = frame.cloud.count, self.pipeline.features
        shapes: dict[str, tuple[int, ...]] = {
            **{"means": (count, 3), "quats": (count, 4), "scales": (count, 2), "opacities": (count,)},
            **{"grad2d": (count,)},
            **{name: (k,) for name, k in _SUMS.items()},
        }
        if "color_sh" in features.effects:
            shapes["sh"] = (count, (features.sh_degree + 1) ** 2, 3)
        else:
            shapes["colors"] = (count, 3)
        if "thickness" in self.pipeline.cloud_arrays:
            shapes["thickness"] = (count,)
        results = {}
        for name, shape in shapes.items():
            argument = name if name == "grad2d" else f"grad_{name}"
            results[name] = frame.pool.array(frame.queue, argument, shape)
            frame.named[argument] = results[name].data  # pyright: ignore[reportArgumentType]
        return results
