"""Direct image alignment on an OpenCL device (kernels/opencl/alignment.cl)."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any, TypeAlias

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
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.uniforms import projection_arrays
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View
from fidsplat.cameras.raster import raster_of
from fidsplat.splats.rotations import nearest_rotation

_GROUPS = {1: 32, 32: 256}
"""maximum number of work-groups of a sum, by the size of a work-group"""
_SUMS = 249
"""numbers that a work-group writes"""
_STATE = 174
"""numbers of `state` in alignment_step.cl, of which the first are read"""
_SETTLED, _NOISE = 0, 3
_INCOMPLETE = 2
_ZERO = np.zeros(1, np.uint32)
_Image: TypeAlias = tuple[cl.Buffer, tuple[int, ...]]


class OpenCLAlignment(AlignmentKernels):
    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self._workspace = workspace
        self._items = 1 if workspace.config.schedule == "lanes" else 32
        self._program = Program(workspace, assemble_alignment(self._items))
        self._commands, self._loop = CommandList(self._program), CommandList(self._program)
        self._steps: dict[type, CommandList] = {}
        """command list of `align_step` by the type of a view's numbers"""
        self._levels: list[dict[str, Any]] = []
        self._replayed: _Replayed | None = None
        self._uploads: deque[cl.Event | None] = deque(maxlen=16)
        """keeps arrays alive until the device has read them"""

    def load(
        self, image: np.ndarray, stages: list[CoarseToFineStage], max_pixels: int, scene: RenderedScene
    ) -> list[int]:
        with self._workspace.lock, self._workspace.device_errors("localising"):
            self._levels, self._stages, self._scene, self._replayed = [], stages, scene, None
            histograms = self._scratch("textures", 4 * BINS * len(stages))
            cl.enqueue_fill_buffer(self._queue, histograms, np.zeros(1, np.uint32), 0, 4 * BINS * len(stages))
            source = full = self._upload("image", image), image.shape
            for number, level in reversed([*enumerate(stages)]):  # each level from the next finer one
                args, source = self._prepared(number, level, source, full, histograms)
                self._levels.insert(0, args)
            counts = np.empty((len(stages), BINS), np.uint32)
            cl.enqueue_copy(self._queue, counts, histograms)
        pixels = []
        for args, histogram in zip(self._levels, counts.astype(np.int64), strict=True):
            args["min_bin"] = min_bin = lowest_bin(histogram, max_pixels)
            pixels.append(int(histogram[min_bin:].sum()))
        return pixels

    def _prepared(
        self, number: int, level: CoarseToFineStage, source: _Image, full: _Image, histograms: cl.Buffer
    ) -> tuple[dict[str, Any], _Image]:
        """Kernel arguments of a pyramid level, and its image before blur. source: the next finer image."""
        camera = level.camera
        finer, (full_height, full_width, channels) = source
        if full_width % camera.width or full_height % camera.height:
            finer, (full_height, full_width, _) = full
        width, height, size = camera.width, camera.height, 4 * camera.width * camera.height
        args = {
            **{"width": width, "height": height, "channels": channels, "block_size": level.block_size},
            **{"full_width": full_width, "full_height": full_height},
            **{"ratio_x": full_width / width, "ratio_y": full_height / height},
            **{"focal_x": camera.fx, "focal_y": camera.fy, "center_x": camera.cx, "center_y": camera.cy},
            **{"lens": int(camera.lens is not None), "rays": finer, "taps": finer, "mask": finer},
            **{"masked": int(level.ignored is not None), "radius": len(level.taps) - 1, "row": number},
            "bins": self._scratch(f"bins {number}", size // 4),
            "counts": histograms,
        }
        if camera.lens is not None:
            raster = raster_of(camera.lens, width, height, camera.fx, camera.fy, camera.cx, camera.cy)
            args["rays"] = self._upload(f"rays {number}", raster.rays)
        if level.ignored is not None:
            args["mask"] = self._upload(f"mask {number}", level.ignored.astype(np.uint8))
        if args["radius"]:
            args["taps"] = self._upload(f"taps {number}", level.taps)
        image = finer
        if (width, height) != (full_width, full_height):
            image = self._scratch(f"image {number}", channels * size)
            grid = -(-width // 64) * 64, height
            self._launch("align_downsample", grid, (64, 1), {**args, "image": finer, "result": image})
        args["image"] = self._blurred(image, args, f"image {number}", channels)
        self._by_groups("align_texture", self._rows(height), args)
        return args, (image, (height, width, channels))

    def frame(self, stage: int, pose: np.ndarray, perturbed: bool = False) -> Any:
        with self._workspace.rendering():
            replayed = self._replay(stage, pose, perturbed)
            if replayed is not None and replayed.frame.count_pairs() is not None:
                return replayed.images(perturbed)
        return super().frame(stage, pose)

    def _replay(self, stage: int, pose: np.ndarray, perturbed: bool = False) -> _Replayed | None:
        """Submit a frame of a pyramid level without waiting; None on CPUs, and for frames whose command list
        depends on the pose."""
        replayed = self._replayed
        size = self._stages[stage].camera.width, self._stages[stage].camera.height
        if replayed is None or not replayed.is_bound(size):
            camera = self._stages[stage].camera.with_pose(pose)
            self._replayed = replayed = _Replayed.of(self._workspace, *self._scene.prepared(camera))
            if replayed is None:
                return None
            replayed.size = size
            if not perturbed:
                return replayed
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
        channels, args = len(fit.gain), self._levels[stage]
        groups = self._groups(args, blocks)
        with self._workspace.lock, self._workspace.device_errors("localising"):
            args = self._sum_arguments(args, frame, fit, groups)
            if perturbed is not None:
                args["perturbed"] = self._blurred(
                    perturbed.frame.images.buffer("rgb"), args, "perturbed frame", 3
                )
                args |= {"has_perturbed": 1, "step": perturbed.size, "axis": perturbed.axis}
            cl.enqueue_fill_buffer(self._queue, args["counts"], _ZERO, 0, 4 * BINS)
            self._upload_fit(fit)
            self._by_groups("align_errors", self._rows(args["height"]), args)
            self._by_groups("align_sums", groups, args)
            packed = np.empty((groups, _SUMS), np.float32)
            cl.enqueue_copy(self._queue, packed, args["result"])
        return _unpacked(packed, channels, blocks, perturbed is not None)

    def minimise(
        self, stage: int, at: Estimate, steps: int, settled: float, damping: float
    ) -> Estimate | None:
        workspace, channels = self._workspace, len(at.fit.gain)
        with workspace.rendering():
            replayed = self._replay(stage, at.pose)
            if replayed is None:
                return None
            args, real = self._levels[stage], replayed.record.dtype.type
            groups = self._groups(args, False)
            state = np.zeros(_STATE, np.float32)
            state[1:6] = np.inf, 10 * damping, 0, 0, at.noise > 0
            buffers = {"state": self._scratch("state", 4 * _STATE), "fit": self._upload_fit(at.fit)}
            self._upload("state", state)
            self._loop.clear()
            args = self._sum_arguments(args, replayed.images(), at.fit, groups, self._loop)
            totals = self._scratch("totals", 4 * (_SUMS + 1))
            args |= {"groups": groups, "totals": totals, "frame_counts": replayed.frame.buffers.counts}
            capacity = replayed.frame.capacity
            args |= {"big_capacity": capacity.big, "pair_capacity": capacity.pairs}
            cl.enqueue_fill_buffer(self._queue, args["counts"], _ZERO, 0, 4 * BINS)
            self._by_groups("align_errors", self._rows(args["height"]), args, self._loop)
            self._by_groups("align_sums", groups, args, self._loop)
            self._launch("align_totals", (256,), (256,), args, self._loop)
            if real not in self._steps:
                self._steps[real] = CommandList(
                    Program(workspace, assemble_alignment_step(real is np.float64))
                )
            step = self._steps[real]
            args |= buffers | {"view": replayed.view, "settled": settled, "channels": channels}
            args |= {"focal": max(args["focal_x"], args["focal_y"]), "pose": self._scratch("pose", 8 * 15)}
            step.clear()
            self._launch("align_step", (1,), (1,), args, step)
            found = np.empty(6, np.float32)
            for number in range(steps + (not at.noise)):  # the first sums may be for the exposure
                if number:
                    replayed.follow()
                    replayed.submit()
                    self._loop.submit(self._queue)
                    step.submit(self._queue)
                cl.enqueue_copy(self._queue, found, buffers["state"])
                if found[_SETTLED]:
                    break
            if found[_SETTLED] == _INCOMPLETE:
                return None
            fit = np.empty(7, np.float32)
            cl.enqueue_copy(self._queue, fit, buffers["fit"])
            exposure = fit[:6].reshape(2, 3)[:, :channels].astype(float)
            fitted = at.fit._replace(gain=exposure[0], offset=exposure[1])
            return Estimate(replayed.pose(), fitted, float(found[_NOISE]))

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
            **{"counts": self._scratch("errors", 4 * BINS), "fit": self._scratch("fit", 28)},
            **{"result": self._scratch("sums", 4 * groups * _SUMS)},
            "noise_factor": noise_factor(len(fit.gain)),
        }

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
        """An image convolved with the taps of a pyramid level; the image itself without blur."""
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

    def _by_groups(
        self, kernel: str, groups: int, args: dict[str, Any], commands: CommandList | None = None
    ) -> None:
        self._launch(kernel, (groups * self._items,), (self._items,), args, commands)

    def _launch(
        self,
        kernel: str,
        size: tuple[int, ...],
        group: tuple[int, ...],
        args: dict[str, Any],
        commands: CommandList | None = None,
    ) -> None:
        """Submit a kernel. commands: list that also records it."""
        if commands is None:
            commands = self._commands
            commands.clear()
        values = [args[argument.name] for argument in commands.program.source.arguments[kernel]]
        commands.launch(self._queue, kernel, size, group, values)

    def _scratch(self, name: str, size: int) -> cl.Buffer:
        return self._workspace.pool.scratch(f"alignment: {name}", size)

    def _upload(self, name: str, array: np.ndarray) -> cl.Buffer:
        """Copy an array to the device, a read-only array only once."""
        name, array = f"alignment: {name}", np.ascontiguousarray(array)
        buffer, event = self._workspace.pool.upload(self._queue, name, array)
        self._uploads.append(event)
        return buffer


class _Replayed:
    """Frames of a pyramid level at other poses, by one command list."""

    def __init__(self, workspace: Workspace, frame: DeviceFrame, images: Any, origin: Any) -> None:
        self._workspace, self.frame, self._images = workspace, frame, images
        arrays = projection_arrays(frame.batch, frame.source, 0, frame.rows)
        self._origin, self.record = origin, arrays["view"].copy()
        # not known to the pool any more, since `align_step` writes it
        self.view = workspace.pool.scratch("view", self.record.nbytes)
        self._buffers = [{f"{name}_out": frame.acquired[f"{name}_out"] for name in ("rgb", "depth")}]
        self._rotation = frame.source.uniform_groups.get("rotation", {})
        self._generation, self._number, self.size = workspace.pool.generation, workspace.frames, (0, 0)

    @classmethod
    def of(
        cls, workspace: Workspace, pipeline: Any, resident: Any, view: View, origin: Any
    ) -> _Replayed | None:
        """Render the view; None if its command list cannot be replayed at other poses."""
        plain = not (view.groups or view.sub_frames or view.parallel) and resident.count
        if pipeline.config.binning == "sort_first" or not plain or not pipeline.fits(resident, view):
            return None
        frame = pipeline.replay_complete(resident, view, 0)
        return None if frame.waits else cls(workspace, frame, pipeline.images_of(frame), origin)

    def is_bound(self, size: tuple[int, int]) -> bool:
        """Whether frames have this size, and no other frame has overwritten the command list's buffers."""
        bound = self._generation, self._number, self.size
        return bound == (self._workspace.pool.generation, self._workspace.frames, size)

    def set_pose(self, pose: np.ndarray) -> None:
        rotation, record = pose[:3, :3], self.record.copy()
        eye = -rotation.T @ pose[:3, 3] - self._origin
        record[:15] = *rotation.ravel(), *(-rotation @ eye), *eye
        self._upload = cl.enqueue_copy(self._queue, self.view, record, is_blocking=False)
        self._set_rotation(record)

    def _set_rotation(self, record: np.ndarray) -> None:
        """Set the kernel arguments that depend on the pose, as of a sky."""
        self.frame.commands.set({name: float(record[index]) for index, name in self._rotation.items()})

    def follow(self) -> None:
        """Set the kernel arguments for the pose that `align_step` has written."""
        if self._rotation:
            self._set_rotation(self._written())

    def submit(self, perturbed: bool = False) -> None:
        """Render the current pose. perturbed: into other images than usual."""
        if perturbed and len(self._buffers) == 1:
            pool = self._workspace.pool
            self._buffers.append(
                {name: pool.scratch(f"perturbed {name}", own.size) for name, own in self._buffers[0].items()}
            )
        self.frame.commands.set(self._buffers[perturbed])
        self._workspace.frames = self._number = self._workspace.frames + 1
        self.frame.events = self.frame.commands.submit(self._queue)
        self.frame.counted = self.frame.events[-1]

    def images(self, perturbed: bool = False) -> Any:
        return SimpleNamespace(
            images=SimpleNamespace(buffer=lambda name: self._buffers[perturbed][f"{name}_out"])
        )

    def _written(self) -> np.ndarray:
        record = np.empty_like(self.record)
        cl.enqueue_copy(self._queue, record, self.view)
        return record

    def pose(self) -> np.ndarray:
        """The pose (4, 4) that `align_step` has written."""
        record, pose = self._written(), np.eye(4)
        pose[:3, :3] = nearest_rotation(record[:9].reshape(3, 3).astype(float))
        pose[:3, 3] = record[9:12] - pose[:3, :3] @ self._origin
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
