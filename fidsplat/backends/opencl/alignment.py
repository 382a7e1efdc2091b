"""Direct image alignment on an OpenCL device (kernels/opencl/alignment.cl)."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from fidsplat.backends.alignment import (
    BINS,
    DAMPING,
    DIFFERENCE,
    STEP,
    AlignmentFit,
    AlignmentKernels,
    AlignmentSums,
    CoarseToFineStage,
    Estimate,
    PerturbedFrame,
    RenderedScene,
    Score,
    noise_factor,
    noise_of,
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
from fidsplat.splats.rotations import orthogonal_again

_GROUPS = {1: 32, 64: 1024}
"""maximum number of work-groups of a sum, by the size of a work-group"""
_GROUP_FLOATS = 249
"""floats that a work-group writes: SUMS of alignment.cl, and the noise"""
_STATE, _STATE_READ = 224, 11
"""floats of the buffer `state` (alignment_step.cl), and how many of them the host reads"""
_CONVERGED, _NOISE, _INCOMPLETE, _EXPOSURE_KNOWN = range(7, 11)
"""indices in `state`, after gain, offset and noise of the next frame"""
_POSE = 15
"""numbers of the pose of a view: rotation, translation and eye"""
_FIRST_CHECK = 4
"""number of steps after which the host first reads whether a stage with at least twice as many has
converged"""
_MAX_RECORDINGS = 8
"""maximum number of attempts to record commands while buffers are replaced"""
_MAX_REPLAYS = 16
"""maximum number of cached command lists of a cloud"""
_ZERO = np.zeros(1, np.uint32)
_Image: TypeAlias = tuple[cl.Buffer, tuple[int, ...]]


class OpenCLAlignment(AlignmentKernels):
    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self._workspace = workspace
        self._items = 1 if workspace.config.schedule == "lanes" else 64
        self._program = Program(workspace, assemble_alignment(self._items))
        self._commands, self._pyramid_commands = CommandList(self._program), CommandList(self._program)
        self._step_programs: dict[bool, Program] = {}
        """programs of `align_step`, by whether view records are float64"""
        self._lists: dict[Any, _StageCommands] = {}
        """command lists of steps, by stage and whether the views are float64; and of scores"""
        self._replays: WeakKeyDictionary[Any, dict[Any, _PoseReplay]] = WeakKeyDictionary()
        self._stage_arguments: list[dict[str, Any]] = []
        """kernel arguments of each stage"""
        self._thresholds: np.ndarray | None = None
        """what `align_thresholds` wrote, once it is read"""
        self._uploads: deque[cl.Event | None] = deque(maxlen=16)
        """keeps arrays alive until the device has read them"""

    def load(
        self, image: np.ndarray, stages: list[CoarseToFineStage], max_pixels: int, scene: RenderedScene
    ) -> None:
        count = len(stages)
        with self._workspace.rendering():
            self._scene, self._thresholds, pool = scene, None, self._workspace.pool
            size = 4 * BINS * (count + 1)
            histograms = pool.zeroed("alignment: textures", size, self._queue)
            full = self._upload("image", image), image.shape
            self._is_uint8 = image.dtype == np.uint8
            key = pool.generation, image.shape, self._is_uint8, max_pixels, [id(stage) for stage in stages]
            if self._pyramid_commands.key != key:
                self._pyramid_commands.clear()
                self._stages, self._stage_arguments, source = stages, [], full
                for number, stage in reversed([*enumerate(stages)]):  # each image from the next finer one
                    args, source = self._prepared(number, stage, source, full, histograms)
                    self._stage_arguments.insert(0, args)
                # the image of the last stage without its blur
                own = {**self._stage_arguments[-1], "stage": count, "stages": count, "max_pixels": max_pixels}
                own["image"] = self._finest
                size = self._size(min(-(-own["height"] // 8), _GROUPS[self._items]))
                self._launch("align_noise", *size, own, self._pyramid_commands)
                self._launch("align_thresholds", *self._size(count + 1), own, self._pyramid_commands)
                self._pyramid_commands.key = pool.generation, *key[1:]
            self._pyramid_commands.submit(self._queue)

    @property
    def pixels(self) -> list[int]:
        count = len(self._stages)
        return self._read_thresholds()[count : 2 * count].tolist()

    @property
    def noise(self) -> float:
        return noise_of(float(self._read_thresholds()[2 * len(self._stages) :].view(np.float32)[0]))

    def _read_thresholds(self) -> np.ndarray:
        if self._thresholds is None:
            buffer, count = self._stage_arguments[0]["thresholds"], 2 * len(self._stages) + 1
            with self._workspace.rendering():
                self._thresholds = self._read(buffer, (count,), np.uint32)
        return self._thresholds

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
        is_uint8 = int(self._is_uint8 and finer is full[0])
        args = {
            **{"width": width, "height": height, "channels": channels, "block_size": stage.block_size},
            **{"full_width": full_width, "full_height": full_height, "is_uint8": is_uint8, "bytes": finer},
            **{"ratio_x": full_width / width, "ratio_y": full_height / height},
            **{"focal_x": camera.fx, "focal_y": camera.fy, "center_x": camera.cx, "center_y": camera.cy},
            # an argument must be a buffer, even where the kernel does not read it
            **{"lens": int(camera.lens is not None), "rays": finer, "taps": finer, "mask": finer},
            **{"masked": int(stage.ignored is not None), "radius": len(stage.taps) - 1, "stage": number},
            "bins": self._scratch(f"bins {number}", size // 4),
            "counts": histograms,
            "thresholds": self._scratch("thresholds", 4 * 64),
        }
        if camera.lens is not None:
            raster = raster_of(camera.lens, width, height, camera.fx, camera.fy, camera.cx, camera.cy)
            args["rays"] = self._upload(f"rays {number}", raster.rays)
        if stage.ignored is not None:
            args["mask"] = self._upload(f"mask {number}", stage.ignored.astype(np.uint8))
        if args["radius"]:
            args["taps"] = self._upload(f"taps {number}", stage.taps)
        image = finer
        if (width, height) != (full_width, full_height) or is_uint8:
            image = self._scratch(f"image {number}", channels * size)
            grid = -(-width // 64) * 64, height
            arguments = {**args, "image": finer, "result": image}
            self._launch("align_downsample", grid, (64, 1), arguments, self._pyramid_commands)
        if not self._stage_arguments:
            self._finest = image
        args["image"] = self._blurred(image, args, f"image {number}", channels, self._pyramid_commands)
        self._launch("align_texture", *self._size(self._rows(height)), args, self._pyramid_commands)
        return args, (image, (height, width, channels))

    def _replay(self, pose: np.ndarray) -> _PoseReplay | None:
        """The replayed frames of the last stage. GPUs downsample them for the coarser stages instead of
        rendering small frames, which have few tiles with long lists. None if the frames cannot be replayed:
        on CPUs, beyond the memory budget, for an empty cloud, with moving groups, a shutter or parallel rays.
        pose: any valid pose."""
        camera, cloud = self._stages[-1].camera, self._scene.cloud
        sizes = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        key = self._scene.capture, *sizes, camera.near, camera.far, camera.lens
        replays = self._replays.setdefault(cloud, {})
        replayed = replays.get(key)
        if replayed is None or not replayed.bind():
            if len(replays) >= _MAX_REPLAYS:
                replays.clear()
            pipeline, view, origin = self._scene.prepared(camera.with_pose(pose))
            replayed = _PoseReplay.of(self._workspace, pipeline, cloud, view, origin)
            if replayed is None:
                return None
            replays[key] = replayed
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
            rendered, depth = (frame.images.buffer(name) for name in ("rgb", "depth"))
            args = self._sum_arguments(args, rendered, depth, channels, fit.huber, groups)
            args["fit"] = self._upload("fit", _packed_fit(fit))
            if self._items == 1:
                args["rgb"] = self._blurred(rendered, args, "render", 3)
            if perturbed is not None:
                args["perturbed"] = self._blurred(
                    perturbed.frame.images.buffer("rgb"), args, "perturbed frame", 3
                )
                args |= {"has_perturbed": 1, "step": perturbed.size, "axis": perturbed.axis}
            self._clear_residual_histogram()
            self._launch("align_errors", *self._residual_grid(args), args)
            self._launch("align_sums", *self._sums_size(groups, channels), args)
            packed = self._read(args["result"], (groups, _GROUP_FLOATS))
        return _unpacked(packed, channels, blocks, perturbed is not None)

    def block_sums(self, stage: int, at: Estimate) -> AlignmentSums:
        with self._workspace.rendering():
            replayed = self._replay(at.pose) if stage == len(self._stages) - 1 else None
            if replayed is not None:
                commands, channels = self._score_commands(stage, replayed, len(at.fit.gain)), len(at.fit.gain)
                replayed.set_pose(at.pose)
                self._copy(commands.state, _packed_fit(at.fit))
                self._clear_residual_histogram()
                replayed.submit()
                commands.sums[0].submit(self._queue)
                packed = self._read(commands.result, (commands.groups, _GROUP_FLOATS))
                if replayed.is_complete():
                    return _unpacked(packed, channels, True, False)
        return super().block_sums(stage, at)

    def minimise(
        self, at: Estimate, steps: Sequence[tuple[int, int]], last: int | None, tolerance: float
    ) -> tuple[Estimate, Score | None] | None:
        if self._items == 1:
            return None
        pose = at.pose
        for attempt in range(_MAX_RECORDINGS):
            with self._workspace.rendering():
                recorded = self._recorded(at, steps, last, tolerance)
                if recorded is not None:
                    state, pose, score = self._minimise(at, steps, *recorded)
                    if not state[_INCOMPLETE]:
                        gain, offset = state[:6].reshape(2, 3)[:, : len(at.fit.gain)].astype(float)
                        fit = at.fit._replace(gain=gain, offset=offset)
                        return Estimate(pose, fit, float(state[_NOISE])), score
            if not all(self.pixels) or (recorded is None and attempt):
                return None
            self.frame(len(self._stages) - 1, pose)  # allocates or enlarges the buffers of the lists
        return None

    def _recorded(
        self, at: Estimate, steps: Sequence[tuple[int, int]], last: int | None, tolerance: float
    ) -> tuple[_PoseReplay, list[_StageCommands], _StageCommands | None] | None:
        """Frames, commands of each stage, and of the score at the stage `last`. None if the frames cannot be
        replayed."""
        channels, pool = len(at.fit.gain), self._workspace.pool
        for _ in range(_MAX_RECORDINGS):  # recording may replace buffers of earlier recordings
            generation, replayed = pool.generation, self._replay(at.pose)
            if replayed is None:
                continue
            commands = [self._step_commands(stage, replayed, channels, tolerance) for stage, _ in steps]
            score = None if last is None else self._score_commands(last, replayed, channels)
            if replayed.bind() and pool.generation is generation:
                return replayed, commands, score
        return None

    def _minimise(
        self,
        at: Estimate,
        steps: Sequence[tuple[int, int]],
        replayed: _PoseReplay,
        stage_commands: list[_StageCommands],
        score_commands: _StageCommands | None,
    ) -> tuple[np.ndarray, np.ndarray, Score | None]:
        """Submit all frames of some stages and of a score, then read the buffer `state`, the pose and the
        score."""
        queue, channels, exposure_known = self._queue, len(at.fit.gain), at.noise > 0
        state = np.zeros(_STATE, np.float32)
        state[:8] = _packed_fit(at.fit)
        state[_CONVERGED], state[_EXPOSURE_KNOWN] = 1, exposure_known
        self._copy(stage_commands[0].state, state)
        before = self._upload("first pose", replayed.packed(at.pose))
        self._clear_residual_histogram()
        for (_, limit), commands in zip(steps, stage_commands, strict=True):
            commands.steps.set({"before": before})
            commands.steps.submit(queue, 0, 1)
            before = replayed.view
            for step in range(limit if exposure_known else limit + 1):
                # wait only where convergence is likely, so that frames are submitted while the device works
                if (
                    step >= (_FIRST_CHECK if limit >= 2 * _FIRST_CHECK else 1)
                    and self._read(commands.state, (_STATE_READ,))[_CONVERGED]
                ):
                    break
                # the first sums only determine the exposure, if it is unknown: the pose stays the same
                if exposure_known or step != 1:
                    replayed.submit()
                commands.sums[0].submit(queue)
                commands.steps.submit(queue, 1, 2)
                queue.flush()
            exposure_known = True
        score = None
        if (commands := score_commands) is not None:
            commands.steps.set({"before": before})
            commands.steps.submit(queue, 0, 1)
            for step, sums in enumerate(commands.sums, 1):
                replayed.submit(perturbed=step > 1)
                sums.submit(queue)
                commands.steps.submit(queue, step, step + 1)
                queue.flush()
            score = self._read_score(commands, channels)
        state = self._read(stage_commands[0].state, (_STATE_READ,))
        # a score leaves its pose in `pose`; the last step is in the view
        source = replayed.view if score_commands is None else score_commands.pose
        return state, replayed.world_to_camera(self._read(source, (_POSE,), replayed.record.dtype)), score

    def _read_score(self, commands: _StageCommands, channels: int) -> Score:
        packed = self._read(commands.result, (commands.groups, _GROUP_FLOATS))
        totals = self._read(commands.totals, (len(commands.sums), _GROUP_FLOATS - 1))
        sums, stage = _unpacked(packed, channels, True, False), len(self._stages) - 1
        rhs = totals[1:, :240].reshape(-1, 3, 10, 8)[:, :channels, 8:].swapaxes(2, 3).astype(float)
        return Score(
            sums,
            {
                axis: one / self.motion_size(stage, axis, sums)
                for axis, one in zip(self.axes(stage), rhs, strict=True)
            },
        )

    def _step_commands(
        self, stage: int, replayed: _PoseReplay, channels: int, tolerance: float
    ) -> _StageCommands:
        """Commands of Levenberg-Marquardt at a stage."""
        args, groups = self._stage_arguments[stage], self._groups(self._stage_arguments[stage], False)
        commands, is_recorded = self._stage_commands(("steps", stage), replayed, (tolerance, channels), 1)
        if not is_recorded:
            args = self._replayed_arguments(args, replayed, channels, True, groups) | {"axis": STEP}
            args |= {"tolerance": tolerance, "row": 0}
            sums, grid = commands.sums[0], (-(-args["width"] // 64) * 64, args["height"])
            if args["reduced"] is not None:
                own = {"channels": 3, "image": replayed.images[False]["rgb_out"], "result": args["reduced"]}
                self._launch("align_downsample", grid, (64, 1), args | own, sums)
            self._launch("align_errors", *self._residual_grid(args), args, sums)
            self._launch("align_sums", *self._sums_size(groups, channels), args, sums)
            self._launch("align_start", (1,), (1,), args, commands.steps)
            self._launch("align_step", (BINS,), (BINS,), args, commands.steps)
            commands.bind(args)
            commands.steps.key = self._workspace.pool.generation, *commands.steps.key[1:]
        return commands

    def _score_commands(self, stage: int, replayed: _PoseReplay, channels: int) -> _StageCommands:
        """Commands of the score: sums of the frame by blocks, and of the perturbed frames."""
        args, axes = self._stage_arguments[stage], (*self.axes(stage), 6)
        commands, is_recorded = self._stage_commands(("score", stage), replayed, (channels,), len(axes))
        if is_recorded:
            return commands
        groups = self._groups(args, True)
        args = self._replayed_arguments(args, replayed, channels, False, groups) | {"tolerance": 0.0}
        args["result"] = self._scratch("block sums", 4 * groups * _GROUP_FLOATS)
        commands.bind(args)
        self._launch("align_start", (1,), (1,), args, commands.steps)
        for row, (axis, sums) in enumerate(zip(axes, commands.sums, strict=True)):
            if row:
                image = replayed.images[True]["rgb_out"]
                args["perturbed"] = self._blurred(image, args, "perturbed frame", 3, sums)
                groups = self._groups(args, False)
                args |= {"has_perturbed": 1, "axis": axes[row - 1] % 3, "groups": groups}
                args["result"] = self._scratch("sums", 4 * groups * _GROUP_FLOATS)
            else:
                self._launch("align_errors", *self._residual_grid(args), args, sums)
            self._launch("align_sums", *self._sums_size(groups, channels), args, sums)
            self._launch("align_step", (BINS,), (BINS,), args | {"axis": axis, "row": row}, commands.steps)
        commands.steps.key = self._workspace.pool.generation, *commands.steps.key[1:]
        return commands

    def _stage_commands(
        self, name: tuple[str, int], replayed: _PoseReplay, parameters: tuple[Any, ...], count: int
    ) -> tuple[_StageCommands, bool]:
        """Cached commands, and whether they are recorded; `count` lists of sums. parameters: values of kernel
        arguments."""
        double = replayed.record.dtype == np.float64
        if double not in self._step_programs:
            self._step_programs[double] = Program(self._workspace, assemble_alignment_step(double))
        cached = self._lists.get((*name, double))
        key = self._workspace.pool.generation, replayed, parameters, self._stage_arguments[name[1]]
        if cached is not None and cached.steps.key == key:
            return cached, True
        sums = [CommandList(self._program) for _ in range(count)]
        commands = _StageCommands(sums, CommandList(self._step_programs[double]))
        commands.steps.key = key
        self._lists[(*name, double)] = commands
        return commands, False

    def _replayed_arguments(
        self, args: dict[str, Any], replayed: _PoseReplay, channels: int, huber: bool, groups: int
    ) -> dict[str, Any]:
        """Arguments of all kernels of a step."""
        image, depth = (replayed.images[False][name] for name in ("rgb_out", "depth_out"))
        camera, reduced = self._stages[-1].camera, None
        if (args["width"], args["height"]) != (camera.width, camera.height):
            image = reduced = self._scratch("reduced render", 12 * args["width"] * args["height"])
        args = self._sum_arguments(args, image, depth, channels, huber, groups)
        args |= {"full_width": camera.width, "full_height": camera.height, "is_uint8": 0, "reduced": reduced}
        args |= {"ratio_x": camera.width / args["width"], "ratio_y": camera.height / args["height"]}
        args["depth_width"] = camera.width
        state = self._scratch("state", 4 * _STATE)
        args |= {"fit": state, "state": state, "pose": self._scratch("pose", 8 * _POSE), "groups": groups}
        args |= {"totals": self._scratch("totals", 4 * 7 * _GROUP_FLOATS), "before": args["pose"]}
        args |= {"damping": DAMPING, "difference": DIFFERENCE, "focal": max(args["focal_x"], args["focal_y"])}
        return args | replayed.arguments()

    def _read(self, buffer: cl.Buffer, shape: tuple[int, ...], dtype: Any = np.float32) -> np.ndarray:
        """Read the beginning of a buffer."""
        values = np.empty(shape, dtype)
        cl.enqueue_copy(self._queue, values, buffer)
        return values

    def _copy(self, buffer: cl.Buffer, array: np.ndarray) -> None:
        """Copy an array to the beginning of a buffer without waiting."""
        self._uploads.append(cl.enqueue_copy(self._queue, buffer, array, is_blocking=False))

    def _groups(self, args: dict[str, Any], blocks: bool) -> int:
        """Number of work-groups of the sums; with `blocks` one for each block."""
        count = -(-args["height"] // args["block_size"]) * -(-args["width"] // args["block_size"])
        return count if blocks else min(count, _GROUPS[self._items])

    def _sum_arguments(
        self,
        args: dict[str, Any],
        rendered: cl.Buffer,
        depth: cl.Buffer,
        channels: int,
        huber: bool,
        groups: int,
    ) -> dict[str, Any]:
        """Arguments of `align_errors` and `align_sums` for an image and its depth."""
        blurred = rendered
        if args["radius"]:
            blurred = self._scratch("blurred render", 12 * args["width"] * args["height"])
        return args | {
            **{"rendered": rendered, "rgb": blurred, "depth": depth, "perturbed": blurred},
            **{"has_perturbed": 0, "step": 1.0, "axis": 0, "huber": int(huber)},
            **{"depth_width": args["width"], "ratio_x": 1.0, "ratio_y": 1.0},
            "counts": self._residual_histogram(),
            "result": self._scratch("sums", 4 * groups * _GROUP_FLOATS),
            "noise_factor": noise_factor(channels),
        }

    def _residual_histogram(self) -> cl.Buffer:
        """Histogram of the residuals (BINS,) uint32."""
        return self._scratch("residual histogram", 4 * BINS)

    def _clear_residual_histogram(self) -> None:
        """Clear the histogram of residuals, to which `align_errors` adds; a step clears it too."""
        cl.enqueue_fill_buffer(self._queue, self._residual_histogram(), _ZERO, 0, 4 * BINS)

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

    def _residual_grid(self, args: dict[str, Any]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        spans = -(-args["width"] * args["height"] // self._items)
        return self._size(min(spans, 4096 if self._items > 1 else _GROUPS[1]))

    def _sums_size(self, groups: int, channels: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """On GPUs each work-group sums one channel."""
        return self._size(groups * (channels if self._items > 1 else 1))

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


class _StageCommands:
    """Command lists of a stage: the sums of a frame, or of a frame and of each perturbed frame; `align_start`
    and the steps."""

    def __init__(self, sums: list[CommandList], steps: CommandList) -> None:
        self.sums, self.steps = sums, steps

    def bind(self, args: dict[str, Any]) -> None:
        """Set the buffers that the host reads, from arguments of the kernels."""
        self.state, self.pose, self.totals = args["state"], args["pose"], args["totals"]
        self.result, self.groups = args["result"], args["groups"]


class _PoseReplay:
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
        buffers of the images of perturbed frames."""
        pool = workspace.pool
        self._workspace, self._recorded, self._origin, self._owner = workspace, frame.recorded, origin, owner
        self._template = frame.view
        self.record = view_records(frame.batch, 0, frame.rows, frame.source.records["View"])
        self.record.flags.writeable = False  # so that `BufferPool.upload` copies the record once
        self._counts = frame.acquired["frame_counts"]
        own = {f"{name}_out": frame.acquired[f"{name}_out"] for name in ("rgb", "depth")}
        self.images = own, perturbed
        self._generation, self._number = pool.generation, -1

    @classmethod
    def of(
        cls, workspace: Workspace, pipeline: Any, cloud: Any, view: View, origin: np.ndarray
    ) -> _PoseReplay | None:
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
        workspace.pool.scratch(_name_of(view), pipeline.source.records["View"].itemsize)
        # a pair limit that no other caller uses, so that the recording is not shared: its buffer of the
        # record `View` is not the pool's `view`
        frame = pipeline.replay_undivided(cloud, view, sys.maxsize)
        owner = pipeline.images_of(frame)
        replayed = None if frame.recorded is None else cls(workspace, frame, owner, origin, scratch)
        return replayed if replayed is not None and replayed.bind() else None

    def bind(self) -> bool:
        """Restore the buffers that other frames have overwritten; False if a buffer was replaced."""
        workspace, queue = self._workspace, self._queue
        if workspace.pool.generation is not self._generation:
            return False
        if workspace.frames != self._number:
            if not self._recorded.set_view(self._template, queue):
                return False
            # kernels overwrite the pose in the buffer `view`; frames of another capture overwrite all of it
            self.view, self._upload = workspace.pool.upload(queue, _name_of(self._template), self.record)
            self._recorded.commands.set({"frame_counts": self._counts, "view": self.view})
        return True

    def arguments(self) -> dict[str, Any]:
        """Arguments of the kernels of alignment_step.cl."""
        capacity = self._recorded.capacity
        return {
            **{"frame_counts": self._counts, "view": self.view, "near": self._template.near},
            **{"big_capacity": capacity.big, "pair_capacity": capacity.pairs},
        }

    def packed(self, pose: np.ndarray) -> np.ndarray:
        """Rotation, translation and eye of a view (15,)."""
        rotation, packed = pose[:3, :3], np.empty(_POSE, self.record.dtype)
        eye = -rotation.T @ pose[:3, 3] - self._origin
        packed[:9], packed[9:12], packed[12:] = rotation.ravel(), -rotation @ eye, eye
        return packed

    def set_pose(self, pose: np.ndarray) -> None:
        """Set the pose, and reset the near plane, which a converged stage sets to infinity
        (alignment_step.cl)."""
        record = self.record.copy()
        record[:_POSE] = self.packed(pose)
        self._upload = cl.enqueue_copy(self._queue, self.view, record, is_blocking=False)

    def submit(self, perturbed: bool = False) -> None:
        commands = self._recorded.commands
        commands.set(self.images[perturbed])
        self._workspace.frames = self._number = self._workspace.frames + 1
        commands.submit(self._queue)

    def is_complete(self) -> bool:
        """Whether the lists of the last frame were large enough; waits for its counts."""
        return self._recorded.capacity.holds(Counts.read(self._queue, self._counts))

    def world_to_camera(self, numbers: np.ndarray) -> np.ndarray:
        """(4, 4) pose from a view's rotation and translation."""
        pose = np.eye(4)
        pose[:3, :3] = orthogonal_again(numbers[:9].reshape(3, 3).astype(float))
        pose[:3, 3] = numbers[9:12] - pose[:3, :3] @ self._origin
        return pose

    @property
    def _queue(self) -> cl.CommandQueue:
        return self._workspace.switch_to(self._workspace.replay_queue)


def _name_of(view: View) -> str:
    """Name of the buffer of a view."""
    return f"alignment: view {view.width} x {view.height}"


def _packed_fit(fit: AlignmentFit) -> np.ndarray:
    """(8,) float32: gain and offset of three channels, noise, and whether the stage has converged."""
    values = np.ones(8, np.float32)
    for first, numbers in ((0, fit.gain), (3, fit.offset), (6, [fit.noise, 0])):
        values[first : first + len(numbers)] = numbers
    return values


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
