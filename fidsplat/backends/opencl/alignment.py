"""Direct image alignment on an OpenCL device (kernels/opencl/alignment.cl)."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from fidsplat.backends.alignment import (
    BINS,
    AlignmentFit,
    AlignmentKernels,
    AlignmentSums,
    CoarseToFineStage,
    Estimate,
    PerturbedFrame,
    RenderedScene,
    lowest_bin,
    noise_factor,
)
from fidsplat.backends.opencl.assemble import assemble_alignment, assemble_alignment_step
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.counts import Counts
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.uniforms import view_records
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View
from fidsplat.cameras.raster import raster_of

_GROUPS = {1: 32, 32: 256}
"""maximum number of work-groups of a sum, by the size of a work-group"""
_GROUP_FLOATS = 249
"""floats that a work-group writes: SUMS of alignment.cl, and the noise"""
_STATE = 192
"""floats of the buffer `state` (alignment_step.cl); the host reads the first `_COST`"""
_CONVERGED, _NOISE, _POSE, _COST = 0, 1, 2, 20
_INCOMPLETE = 2
"""indices in `state`, and value of `state[CONVERGED]` if a frame exceeded its buffers"""
_MAX_REPLAYS = 16
"""maximum number of cached command lists of a cloud"""
_ZERO = np.zeros(1, np.uint32)
_Image: TypeAlias = tuple[cl.Buffer, tuple[int, ...]]


class OpenCLAlignment(AlignmentKernels):
    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self._workspace = workspace
        self._items = 1 if workspace.config.schedule == "lanes" else 32
        self._program = Program(workspace, assemble_alignment(self._items))
        self._commands, self._pyramid_commands = CommandList(self._program), CommandList(self._program)
        self._steps: dict[bool, Program] = {}
        """programs of `align_step`, by whether view records are float64"""
        self._lists: dict[tuple[int, bool], tuple[CommandList, CommandList]] = {}
        self._replays: WeakKeyDictionary[Any, dict[Any, _Replayed]] = WeakKeyDictionary()
        self._stage_arguments: list[dict[str, Any]] = []
        """kernel arguments of each stage"""
        self._uploads: deque[cl.Event | None] = deque(maxlen=16)
        """keeps arrays alive until the device has read them"""

    def load(
        self, image: np.ndarray, stages: list[CoarseToFineStage], max_pixels: int, scene: RenderedScene
    ) -> list[int]:
        with self._workspace.lock, self._workspace.device_errors("localising"):
            self._scene = scene
            histograms = self._scratch("textures", 4 * BINS * len(stages))
            full = self._upload("image", image), image.shape
            key = self._workspace.pool.generation, image.shape, [id(stage) for stage in stages]
            if self._pyramid_commands.key != key:
                self._pyramid_commands.clear()
                self._stages, self._stage_arguments, source = stages, [], full
                for number, stage in reversed([*enumerate(stages)]):  # each image from the next finer one
                    args, source = self._prepared(number, stage, source, full, histograms)
                    self._stage_arguments.insert(0, args)
                self._pyramid_commands.key = self._workspace.pool.generation, *key[1:]
            cl.enqueue_fill_buffer(self._queue, histograms, _ZERO, 0, 4 * BINS * len(stages))
            self._pyramid_commands.submit(self._queue)
            texture_histograms = np.empty((len(stages), BINS), np.uint32)
            cl.enqueue_copy(self._queue, texture_histograms, histograms)
        pixels = []
        for args, texture_histogram in zip(
            self._stage_arguments, texture_histograms.astype(np.int64), strict=True
        ):
            args["min_bin"] = min_bin = lowest_bin(texture_histogram, max_pixels)
            pixels.append(int(texture_histogram[min_bin:].sum()))
        return pixels

    def _prepared(
        self, number: int, stage: CoarseToFineStage, source: _Image, full: _Image, histograms: cl.Buffer
    ) -> tuple[dict[str, Any], _Image]:
        """Record the kernels of a stage; returns their arguments, and the image before blur.

        number: index of the stage. source: the next finer image.
        """
        camera = stage.camera
        finer, (full_height, full_width, channels) = source
        if full_width % camera.width or full_height % camera.height:
            finer, (full_height, full_width, _) = full
        width, height, size = camera.width, camera.height, 4 * camera.width * camera.height
        args = {
            **{"width": width, "height": height, "channels": channels, "block_size": stage.block_size},
            **{"full_width": full_width, "full_height": full_height},
            **{"ratio_x": full_width / width, "ratio_y": full_height / height},
            **{"focal_x": camera.fx, "focal_y": camera.fy, "center_x": camera.cx, "center_y": camera.cy},
            # an argument must be a buffer, even where the kernel does not read it
            **{"lens": int(camera.lens is not None), "rays": finer, "taps": finer, "mask": finer},
            **{"masked": int(stage.ignored is not None), "radius": len(stage.taps) - 1, "row": number},
            "bins": self._scratch(f"bins {number}", size // 4),
            "counts": histograms,
        }
        if camera.lens is not None:
            raster = raster_of(camera.lens, width, height, camera.fx, camera.fy, camera.cx, camera.cy)
            args["rays"] = self._upload(f"rays {number}", raster.rays)
        if stage.ignored is not None:
            args["mask"] = self._upload(f"mask {number}", stage.ignored.astype(np.uint8))
        if args["radius"]:
            args["taps"] = self._upload(f"taps {number}", stage.taps)
        image = finer
        if (width, height) != (full_width, full_height):
            image = self._scratch(f"image {number}", channels * size)
            grid = -(-width // 64) * 64, height
            arguments = {**args, "image": finer, "result": image}
            self._launch("align_downsample", grid, (64, 1), arguments, self._pyramid_commands)
        args["image"] = self._blurred(image, args, f"image {number}", channels, self._pyramid_commands)
        self._launch("align_texture", *self._size(self._rows(height)), args, self._pyramid_commands)
        return args, (image, (height, width, channels))

    def frame(self, stage: int, pose: np.ndarray, perturbed: bool = False) -> Any:
        with self._workspace.rendering():
            replayed = self._replay(stage, pose, perturbed)
            if replayed is not None and replayed.is_complete():
                return replayed.images[perturbed]
        return super().frame(stage, pose)

    def _replay(self, stage: int, pose: np.ndarray, perturbed: bool = False) -> _Replayed | None:
        """Submit a frame of a stage without waiting. None if it cannot be replayed: on CPUs, in chunks, for
        an empty cloud, with moving groups, a shutter or parallel rays."""
        camera, (cloud, capture) = self._stages[stage].camera, self._scene.key
        sizes = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        key = capture, *sizes, camera.near, camera.far, camera.lens
        replays = self._replays.setdefault(cloud, {})
        replayed = replays.get(key)
        if replayed is None or not replayed.bind():
            if len(replays) >= _MAX_REPLAYS:
                replays.clear()
            replayed = _Replayed.of(self._workspace, *self._scene.prepared(camera.with_pose(pose)))
            if replayed is None:
                return None
            replays[key] = replayed
        replayed.set_pose(pose)
        replayed.submit(perturbed)
        return replayed

    def sums(
        self,
        stage: int,
        frame: Any,
        fit: AlignmentFit,
        perturbed: PerturbedFrame | None = None,
        blocks: bool = False,
    ) -> AlignmentSums:
        channels, args = len(fit.gain), self._stage_arguments[stage]
        groups = self._groups(args, blocks)
        with self._workspace.lock, self._workspace.device_errors("localising"):
            args = self._sum_arguments(args, frame, fit, groups)
            if perturbed is not None:
                args["perturbed"] = self._blurred(
                    perturbed.frame.images.buffer("rgb"), args, "perturbed frame", 3
                )
                args |= {"has_perturbed": 1, "step": perturbed.size, "axis": perturbed.axis}
            self._clear_errors()
            self._upload_fit(fit)
            self._by_groups("align_errors", self._rows(args["height"]), args)
            self._by_groups("align_sums", groups, args)
            packed = np.empty((groups, _GROUP_FLOATS), np.float32)
            cl.enqueue_copy(self._queue, packed, args["result"])
        return _unpacked(packed, channels, blocks, perturbed is not None)

    def derivatives(
        self, stage: int, frame: Any, fit: AlignmentFit, motions: Sequence[tuple[np.ndarray, float, int]]
    ) -> list[np.ndarray]:
        workspace, stage_arguments = self._workspace, self._stage_arguments[stage]
        with workspace.rendering():
            if isinstance(frame, _ReplayedImages):
                groups, totals = self._groups(stage_arguments, False), []
                args = self._sum_arguments(stage_arguments, frame, fit, groups)
                self._clear_errors()
                self._upload_fit(fit)
                self._by_groups("align_errors", self._rows(stage_arguments["height"]), args)
                for number, (pose, size, axis) in enumerate(motions):
                    replayed = self._replay(stage, pose, True)
                    if replayed is None:
                        break
                    image = replayed.images[True].buffer("rgb")
                    args["perturbed"] = self._blurred(image, args, "perturbed frame", 3)
                    args |= {"has_perturbed": 1, "step": size, "axis": axis}
                    self._by_groups("align_sums", groups, args)
                    totals.append(self._scratch(f"totals {number}", 4 * (_GROUP_FLOATS + 1)))
                    # `align_totals` clears `counts`: another buffer, so that the histogram of residuals stays
                    counts = {"counts": self._scratch("unused", 4 * BINS)}
                    self._launch(
                        *("align_totals", (256,), (256,)),
                        args | counts | replayed.arguments(groups, totals[-1]),
                    )
                packed = np.empty((len(totals), _GROUP_FLOATS + 1), np.float32)
                for row, buffer in zip(packed, totals, strict=True):
                    cl.enqueue_copy(self._queue, row, buffer)
                if len(totals) == len(motions) and not packed[:, _GROUP_FLOATS].any():
                    return [
                        _unpacked(row[None, :_GROUP_FLOATS], len(fit.gain), False, True).rhs for row in packed
                    ]
        return super().derivatives(stage, frame, fit, motions)

    def minimise(
        self, stage: int, at: Estimate, steps: int, tolerance: float, damping: float
    ) -> Estimate | None:
        channels = len(at.fit.gain)
        with self._workspace.rendering():
            replayed = self._replay(stage, at.pose)
            if replayed is None:
                return None
            state = np.zeros(_STATE, np.float32)
            state[_COST : _COST + 4] = np.inf, 10 * damping, 0, at.noise > 0
            buffer = self._upload("state", state)
            self._upload_fit(at.fit)
            lists = self._step_lists(stage, replayed, at.fit, tolerance)
            self._clear_errors()
            found = np.empty(_COST, np.float32)
            # one more iteration if the noise is unknown: the first one estimates it
            for number in range(steps + (not at.noise)):
                if number:
                    replayed.set_rotation(found[_POSE : _POSE + 9])
                    replayed.submit()
                for commands in lists:
                    commands.submit(self._queue)
                cl.enqueue_copy(self._queue, found, buffer)
                if found[_CONVERGED]:
                    break
        if found[_CONVERGED] == _INCOMPLETE:
            return None
        gain, offset = found[_POSE + 12 :].reshape(2, 3)[:, :channels].astype(float)
        pose = replayed.world_to_camera(found[_POSE : _POSE + 12])
        return Estimate(pose, at.fit._replace(gain=gain, offset=offset), float(found[_NOISE]))

    def _step_lists(
        self, stage: int, replayed: _Replayed, fit: AlignmentFit, tolerance: float
    ) -> tuple[CommandList, CommandList]:
        """Command lists of the sums of a frame, and of a step."""
        stage_arguments, double = self._stage_arguments[stage], replayed.record.dtype == np.float64
        if double not in self._steps:
            self._steps[double] = Program(self._workspace, assemble_alignment_step(double))
        if (stage, double) not in self._lists:
            self._lists[stage, double] = CommandList(self._program), CommandList(self._steps[double])
        sums, step = lists = self._lists[stage, double]
        key = self._workspace.pool.generation, replayed, tolerance, stage_arguments | {"min_bin": 0}
        if sums.key == key:
            sums.set({"min_bin": stage_arguments["min_bin"]})
            return lists
        sums.clear()
        step.clear()
        groups = self._groups(stage_arguments, False)
        args = self._sum_arguments(stage_arguments, replayed.images[0], fit, groups, sums)
        args |= replayed.arguments(groups, self._scratch("totals", 4 * (_GROUP_FLOATS + 1)))
        args |= {"state": self._scratch("state", 4 * _STATE), "tolerance": tolerance}
        args |= {"focal": max(args["focal_x"], args["focal_y"]), "pose": self._scratch("pose", 8 * 15)}
        self._launch("align_errors", *self._size(self._rows(stage_arguments["height"])), args, sums)
        self._launch("align_sums", *self._size(groups), args, sums)
        self._launch("align_totals", (256,), (256,), args, sums)
        self._launch("align_step", (1,), (1,), args, step)
        sums.key = self._workspace.pool.generation, *key[1:]
        return lists

    def _groups(self, args: dict[str, Any], blocks: bool) -> int:
        """Number of work-groups of the sums; with `blocks` one for each block."""
        count = -(-args["height"] // args["block_size"]) * -(-args["width"] // args["block_size"])
        return count if blocks else min(count, _GROUPS[self._items])

    def _sum_arguments(
        self,
        args: dict[str, Any],
        frame: Any,
        fit: AlignmentFit,
        groups: int,
        commands: CommandList | None = None,
    ) -> dict[str, Any]:
        """Arguments of `align_errors` and `align_sums` for a frame; submits its blur."""
        values = self._blurred(frame.images.buffer("rgb"), args, "render", 3, commands)
        return args | {
            **{"rgb": values, "depth": frame.images.buffer("depth"), "perturbed": values},
            **{"has_perturbed": 0, "step": 1.0, "axis": 0, "huber": int(fit.huber), "row": 0},
            **{"counts": self._errors(), "fit": self._scratch("fit", 28)},
            **{"result": self._scratch("sums", 4 * groups * _GROUP_FLOATS)},
            "noise_factor": noise_factor(len(fit.gain)),
        }

    def _errors(self) -> cl.Buffer:
        """Histogram of the residuals (BINS,) uint32."""
        return self._scratch("errors", 4 * BINS)

    def _clear_errors(self) -> None:
        """Clear the histogram of residuals, to which `align_errors` adds; `align_totals` clears it too."""
        cl.enqueue_fill_buffer(self._queue, self._errors(), _ZERO, 0, 4 * BINS)

    def _upload_fit(self, fit: AlignmentFit) -> cl.Buffer:
        values = np.ones(7, np.float32)
        for first, numbers in ((0, fit.gain), (3, fit.offset), (6, [fit.noise])):
            values[first : first + len(numbers)] = numbers
        return self._upload("fit", values)

    @property
    def _queue(self) -> cl.CommandQueue:
        workspace = self._workspace
        return workspace.switch_to(workspace.queue if self._items == 1 else workspace.replay_queue)

    def _rows(self, height: int) -> int:
        return min(height, _GROUPS[self._items])

    def _blurred(
        self,
        image: cl.Buffer,
        args: dict[str, Any],
        name: str,
        channels: int,
        commands: CommandList | None = None,
    ) -> cl.Buffer:
        """An image convolved with the taps of a stage; the image itself without blur."""
        if not args["radius"]:
            return image
        for vertical in (0, 1):
            size = 4 * channels * args["width"] * args["height"]
            result = self._scratch(f"blurred {vertical} {name}", size)
            pass_arguments = {"image": image, "result": result, "vertical": vertical, "channels": channels}
            width_items = 1 if self._items == 1 else 64
            items = width_items, args["height"]
            self._launch("align_blur", items, (width_items, 1), args | pass_arguments, commands)
            image = result
        return image

    def _by_groups(self, kernel: str, groups: int, args: dict[str, Any]) -> None:
        self._launch(kernel, *self._size(groups), args)

    def _size(self, groups: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        return (groups * self._items,), (self._items,)

    def _launch(
        self,
        kernel: str,
        size: tuple[int, ...],
        group: tuple[int, ...],
        args: dict[str, Any],
        commands: CommandList | None = None,
    ) -> None:
        """Submit a kernel; with `commands` record it instead."""
        own = commands or self._commands
        values = [args[name] for name in own.program.source.arguments[kernel]]
        if commands is not None:
            commands.record(kernel, size, group, values)
            return
        own.clear()
        own.launch(self._queue, kernel, size, group, values)

    def _scratch(self, name: str, size: int) -> cl.Buffer:
        return self._workspace.pool.scratch(f"alignment: {name}", size)

    def _upload(self, name: str, array: np.ndarray) -> cl.Buffer:
        """Copy an array to the device, a read-only array only once."""
        name, array = f"alignment: {name}", np.ascontiguousarray(array)
        buffer, event = self._workspace.pool.upload(self._queue, name, array)
        self._uploads.append(event)
        return buffer


class _ReplayedImages:
    """Images of a replayed frame. `images` is the object itself, so that it replaces a Frame.

    owner: object that owns the image buffers; they return to the pool when it is released.
    """

    def __init__(self, named: dict[str, cl.Buffer], owner: Any = None) -> None:
        self.named, self.images, self._owner = named, self, owner

    def buffer(self, name: str) -> cl.Buffer:
        return self.named[f"{name}_out"]


class _Replayed:
    """Frames of a stage at any pose, by one command list."""

    def __init__(
        self,
        workspace: Workspace,
        frame: DeviceFrame,
        owner: Any,
        origin: np.ndarray,
        perturbed: dict[str, cl.Buffer],
    ) -> None:
        """owner: object that owns the image buffers; they return to the pool when it is released. perturbed:
        buffers of the images of `PerturbedFrame`."""
        pool = workspace.pool
        self._workspace, self._recorded, self._origin = workspace, frame.recorded, origin
        self.record = view_records(frame.batch, 0, frame.rows, frame.source.records["View"])
        self._template = frame.view
        rotation, commands = frame.source.uniform_groups.get("rotation", {}), frame.commands
        self._rotation = [(at, index) for index, name in rotation.items() for at in commands.positions(name)]
        """arguments that depend on the rotation, with indices of its elements"""
        self._counts = frame.acquired["frame_counts"]
        own = {f"{name}_out": frame.acquired[f"{name}_out"] for name in ("rgb", "depth")}
        self.images = _ReplayedImages(own, owner), _ReplayedImages(perturbed)
        self._generation, self._number = pool.generation, -1
        self.view = pool.scratch("view", self.record.nbytes)

    @classmethod
    def of(
        cls, workspace: Workspace, pipeline: Any, cloud: Any, view: View, origin: np.ndarray
    ) -> _Replayed | None:
        """Frames with the size and effects of a view; None if they cannot be replayed."""
        plain = not (view.groups or view.sub_frames or view.parallel) and cloud.count
        if pipeline.config.binning == "sort_first" or not plain or not pipeline.fits(cloud, view):
            return None
        pixels = (view.width // view.samples) * (view.height // view.samples)
        scratch = {
            f"{output.name}_out": workspace.pool.scratch(
                f"perturbed {output.name}", 4 * pixels * output.channels
            )
            for output in pipeline.outputs.values()
        }
        frame = pipeline.replay_undivided(cloud, view, 0)
        owner = pipeline.images_of(frame)
        replayed = None if frame.recorded is None else cls(workspace, frame, owner, origin, scratch)
        return replayed if replayed is not None and replayed.bind() else None

    def bind(self) -> bool:
        """Restore the buffers that other frames have overwritten; False if a buffer was replaced."""
        workspace = self._workspace
        if workspace.pool.generation is not self._generation:
            return False
        if workspace.frames != self._number:
            if not self._recorded.set_view(self._template, self._queue):
                return False
            # `align_step` overwrites this buffer: after `scratch`, the next `upload` copies the view again
            self.view = workspace.pool.scratch("view", self.record.nbytes)
            self._recorded.commands.set({"frame_counts": self._counts})
        return True

    def arguments(self, groups: int, totals: cl.Buffer) -> dict[str, Any]:
        """Arguments of `align_totals` and `align_step`."""
        capacity = self._recorded.capacity
        return {
            **{"groups": groups, "totals": totals, "frame_counts": self._counts, "view": self.view},
            **{"big_capacity": capacity.big, "pair_capacity": capacity.pairs},
        }

    def set_pose(self, pose: np.ndarray) -> None:
        rotation, record = pose[:3, :3], self.record.copy()
        eye = -rotation.T @ pose[:3, 3] - self._origin
        record[:9], record[9:12], record[12:15] = rotation.ravel(), -rotation @ eye, eye
        self._upload = cl.enqueue_copy(self._queue, self.view, record, is_blocking=False)
        self.set_rotation(record)

    def set_rotation(self, rotation: np.ndarray) -> None:
        """Set the kernel arguments that depend on the rotation (9,), as of an environment map."""
        if self._rotation:
            values = rotation.tolist()
            for (command, argument), index in self._rotation:
                command.bind(argument, values[index])

    def submit(self, perturbed: bool = False) -> None:
        commands = self._recorded.commands
        commands.set(self.images[perturbed].named)
        self._workspace.frames = self._number = self._workspace.frames + 1
        self._events = commands.submit(self._queue)

    def is_complete(self) -> bool:
        """Whether the lists of the last frame were large enough; waits for its counts."""
        self._queue.flush()
        counted = self._events[self._recorded.launches_until_counts - 1]
        return self._recorded.capacity.holds(Counts.read(self._workspace.side_queue, self._counts, [counted]))

    def world_to_camera(self, numbers: np.ndarray) -> np.ndarray:
        """(4, 4) pose from a view's rotation and translation."""
        pose, rotation = np.eye(4), numbers[:9].reshape(3, 3).astype(float)
        pose[:3, :3] = rotation @ (1.5 * np.eye(3) - 0.5 * rotation.T @ rotation)  # orthogonal in float64
        pose[:3, 3] = numbers[9:12] - pose[:3, :3] @ self._origin
        return pose

    @property
    def _queue(self) -> cl.CommandQueue:
        return self._workspace.switch_to(self._workspace.replay_queue)


def _unpacked(packed: np.ndarray, channels: int, blocks: bool, perturbed: bool) -> AlignmentSums:
    """Unpack the sums of the work-groups. For each of 3 channels: 8 x 8 normal matrix, right-hand side, and a
    second right-hand side or 6 moments; then scalars."""
    rows = packed[:, :240].reshape(len(packed), 3, 10, 8)[:, :channels]
    total, scalars = rows.sum(axis=0, dtype=float), packed[:, 240:248].sum(axis=0, dtype=float)
    cost, before, inverse_depth = (scalars[4:7] / max(scalars[3], 1)).tolist()
    used = rows[packed[:, 243] > 0 if blocks else slice(0)].astype(float)
    return AlignmentSums(
        *(total[:, :8], np.moveaxis(total[:, 8 : 9 + perturbed], 1, 2), scalars[:channels]),
        *(used[:, :, 8], used[:, :, :8], used[:, :, 9, :6]),
        *(cost, before, inverse_depth, float(packed[0, 248])),
    )
