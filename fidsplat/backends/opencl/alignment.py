"""Direct image alignment on an OpenCL device (kernels/opencl/alignment.cl)."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl

from fidsplat.backends.alignment import (
    BINS,
    AlignmentFit,
    AlignmentKernels,
    AlignmentStage,
    AlignmentSums,
    MovedFrame,
    lowest_bin,
    noise_factor,
)
from fidsplat.backends.opencl.assemble import assemble_alignment
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.cameras.raster import raster_of

_GROUPS = {1: 32, 32: 256}
"""maximum number of work-groups of a sum, by the size of a work-group"""
_SUMS = 249
"""numbers that a work-group writes"""
_Image: TypeAlias = tuple[cl.Buffer, tuple[int, ...]]


class OpenCLAlignment(AlignmentKernels):
    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self._workspace = workspace
        self._items = 1 if workspace.config.schedule == "lanes" else 32
        self._program = Program(workspace, assemble_alignment(self._items))
        self._commands = CommandList(self._program)
        self._levels: list[dict[str, Any]] = []

    def load(self, image: np.ndarray, stages: list[AlignmentStage], max_pixels: int) -> list[int]:
        with self._workspace.lock, self._workspace.device_errors("localising"):
            self._levels = []
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
        self, number: int, level: AlignmentStage, source: _Image, full: _Image, histograms: cl.Buffer
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

    def sums(
        self, stage: int, frame: Any, fit: AlignmentFit, moved: MovedFrame | None = None, blocks: bool = False
    ) -> AlignmentSums:
        args, channels = self._levels[stage], len(fit.gain)
        height, width, block_size = args["height"], args["width"], args["block_size"]
        count = -(-height // block_size) * -(-width // block_size)
        groups = count if blocks else min(count, _GROUPS[self._items])
        rgb, depth = (frame.images.buffer(name) for name in ("rgb", "depth"))
        other, step, axis = moved or (frame, 1.0, 0)
        moved_rgb = rgb if moved is None else other.images.buffer("rgb")
        with self._workspace.lock, self._workspace.device_errors("localising"):
            values = self._blurred(rgb, args, "render", 3)
            if moved is not None:
                moved_rgb = self._blurred(moved_rgb, args, "moved frame", 3)
            counts = self._scratch("errors", 4 * BINS)
            cl.enqueue_fill_buffer(self._queue, counts, np.zeros(1, np.uint32), 0, 4 * BINS)
            sums = self._scratch("sums", 4 * groups * _SUMS)
            exposure = np.ones((2, 3))
            exposure[:, :channels] = fit.gain, fit.offset
            names = (f"{kind}_{name}" for kind in ("gain", "offset") for name in ("red", "green", "blue"))
            args = args | dict(zip(names, exposure.ravel().tolist(), strict=True))
            args |= {"rgb": values, "depth": depth, "counts": counts, "row": 0, "result": sums}
            args |= {"moved": moved_rgb, "has_moved": int(moved is not None), "step": step, "axis": axis}
            args |= {"huber": int(fit.huber), "noise_before": fit.noise}
            args["noise_factor"] = noise_factor(channels)
            self._by_groups("align_errors", self._rows(height), args)
            self._by_groups("align_sums", groups, args)
            packed = np.empty((groups, _SUMS), np.float32)
            cl.enqueue_copy(self._queue, packed, sums)
        return _unpacked(packed, channels, blocks, moved is not None)

    @property
    def _queue(self) -> cl.CommandQueue:
        return self._workspace.switch_to(self._workspace.queue)

    def _rows(self, height: int) -> int:
        return min(height, _GROUPS[self._items])

    def _blurred(self, image: cl.Buffer, args: dict[str, Any], name: str, channels: int) -> cl.Buffer:
        """An image convolved with the taps of a pyramid level; the image itself without blur."""
        if not args["radius"]:
            return image
        for vertical in (0, 1):
            size = 4 * channels * args["width"] * args["height"]
            result = self._scratch(f"blurred {vertical} {name}", size)
            pass_arguments = {"image": image, "result": result, "vertical": vertical, "channels": channels}
            width_items = 1 if self._items == 1 else 64
            self._launch("align_blur", (width_items, args["height"]), (width_items, 1), args | pass_arguments)
            image = result
        return image

    def _by_groups(self, kernel: str, groups: int, args: dict[str, Any]) -> None:
        self._launch(kernel, (groups * self._items,), (self._items,), args)

    def _launch(
        self, kernel: str, size: tuple[int, ...], group: tuple[int, ...], args: dict[str, Any]
    ) -> None:
        values = [args[argument.name] for argument in self._program.source.arguments[kernel]]
        self._commands.clear()
        self._commands.launch(self._queue, kernel, size, group, values)

    def _scratch(self, name: str, size: int) -> cl.Buffer:
        return self._workspace.pool.scratch(f"alignment: {name}", size)

    def _upload(self, name: str, array: np.ndarray) -> cl.Buffer:
        """Copy an array to the device, a read-only array only once."""
        name, array = f"alignment: {name}", np.ascontiguousarray(array)
        buffer, event = self._workspace.pool.upload(self._queue, name, array)
        if event is not None:
            event.wait()
        return buffer


def _unpacked(packed: np.ndarray, channels: int, blocks: bool, moved: bool) -> AlignmentSums:
    """Unpack the sums of the work-groups. For each of 3 channels: 8 x 8 normal matrix, right-hand side, and a
    second right-hand side or 6 moments; then scalars."""
    rows = packed[:, :240].reshape(len(packed), 3, 10, 8)[:, :channels]
    total, scalars = rows.sum(axis=0, dtype=float), packed[:, 240:248].sum(axis=0, dtype=float)
    cost, before, inverse_depth = (scalars[4:7] / max(scalars[3], 1)).tolist()
    used = rows[packed[:, 243] > 0 if blocks else slice(0)].astype(float)
    return AlignmentSums(
        *(total[:, :8], np.moveaxis(total[:, 8 : 9 + moved], 1, 2), scalars[:channels]),
        *(used[:, :, 8], used[:, :, :8], used[:, :, 9, :6]),
        *(cost, before, inverse_depth, float(packed[0, 248])),
    )
