"""Output images on an OpenCL device."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import Images, check_batch_memory, summed
from fidsplat.backends.opencl.assemble import kernel_text
from fidsplat.backends.opencl.device_frame import Rendered
from fidsplat.backends.opencl.program import build, load_invoker
from fidsplat.backends.opencl.recorded_frame import Replay
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects.catalogue import Output
from fidsplat.util.errors import DeviceError, bytes_words

_UINT8_GROUP = 64
_KERNELS: WeakKeyDictionary[Workspace, tuple[cl.Kernel, int]] = WeakKeyDictionary()
"""kernel of uint8.cl, compiled on first use, and values per work-item"""


def acquire_images(
    workspace: Workspace, outputs: tuple[Output, ...], batch: ViewBatch
) -> list[tuple[str, cl.Buffer]]:
    """Buffers for the output images of a batch, (views, h, w, channels) each; `Output.empty_value` in masked
    views. Raises DeviceError if they exceed the memory budget, or one of them exceeds the device's largest
    buffer."""
    pixels = batch.total * batch.size[0] * batch.size[1]
    bytes_of = {output.name: 4 * pixels * output.channels for output in outputs}
    largest = max(bytes_of, key=bytes_of.__getitem__)
    if bytes_of[largest] > workspace.largest_buffer:
        raise DeviceError(
            f"{largest} of {batch.total} views must be at most {bytes_words(workspace.largest_buffer)}, the "
            f"largest buffer of the device, got {bytes_words(bytes_of[largest])}; render fewer views at once"
        )
    check_batch_memory(batch.total, sum(bytes_of.values()), workspace.memory_budget)
    acquired = []
    for output in outputs:
        name = f"{output.name} of views"  # another pool name, as single frames must not reuse batch buffers
        buffer = workspace.pool.acquire(name, bytes_of[output.name])
        acquired.append((name, buffer))
        if len(batch) < batch.total:
            empty = np.full(1, output.empty_value, output.dtype)
            cl.enqueue_fill_buffer(workspace.queue, buffer, empty, 0, bytes_of[output.name])
    return acquired


class OpenCLImages(Images):
    """Output images on an OpenCL device. Their buffers return to the pool when the object is released."""

    def __init__(
        self,
        pipeline: Any,
        batch: ViewBatch | View,
        rendered: list[Rendered],
        splats: int,
        acquired: list[tuple[str, cl.Buffer]] | None = None,
        replay: Replay | None = None,
    ) -> None:
        """pipeline: an OpenCLPipeline. acquired: image buffers of a batch; None for a single frame."""
        self._workspace, self._splats, self._outputs = pipeline.workspace, splats, pipeline.outputs
        self._view = view = batch if isinstance(batch, View) else batch.view
        if isinstance(batch, ViewBatch):
            self.view_count = batch.total
        self._size = view.height // view.samples, view.width // view.samples
        self._rendered, self._replay = rendered, replay
        self._tile = pipeline.config.tile_height, pipeline.config.tile_width
        self._batch = None if acquired is None else dict(zip(self._outputs, acquired, strict=True))
        self._timings: dict[str, float] = {}
        self._copied: list[Rendered] = []
        """frames from which tiles were copied; without their buffers"""
        self._acquired = [*(acquired or ())]
        for part in rendered:
            self._acquired += part.acquired.items()
        weakref.finalize(self, self._workspace.pool.release, self._acquired)

    def read(self, name: str, index: int | None = None) -> np.ndarray:
        if index is not None:
            images = self.empty(name)
            self._copy(name, images, index * images.nbytes)
            return images
        shape = self.view_count, *self._shape(name)
        images = self._workspace.host_memory.empty(shape, self._outputs[name].dtype)
        self._copy(name, images, 0)
        return images

    def empty(self, name: str) -> np.ndarray:
        return self._workspace.host_memory.empty(self._shape(name), self._outputs[name].dtype)

    def read_rows(self, name: str, first: int, end: int, into: np.ndarray, index: int = 0) -> None:
        if first < end:
            self._copy(name, into[first:end], (index * len(into) + first) * into[:1].nbytes)

    def _copy(self, name: str, into: np.ndarray, offset: int) -> None:
        with self._workspace.device_errors(f"rendering {name}"):
            buffer, after = self.buffer(name), self._completion_events()
            # a separate queue: on the queue of the frames, the copy would wait for the next frame
            cl.enqueue_copy(self._workspace.read_queue, into, buffer, src_offset=offset, wait_for=after)

    def _shape(self, name: str) -> tuple[int, ...]:
        """Array shape of the image of one view."""
        channels = self._outputs[name].channels
        return self._size if channels == 1 else (*self._size, channels)

    def buffer(self, name: str) -> cl.Buffer:
        return (
            self.ensure_complete()[0].acquired[f"{name}_out"] if self._batch is None else self._batch[name][1]
        )

    def _completion_events(self) -> list[cl.Event]:
        """Events after which the images are complete."""
        if not self._rendered:  # all views are masked out
            self._workspace.queue.finish()
        for part in self.ensure_complete():
            part.queue.flush()
        return [part.events[-1] for part in self._rendered]

    def read_uint8(self, name: str, index: int = 0) -> np.ndarray:
        workspace, shape, label = self._workspace, self._shape(name), "8 bits of an image"
        into, count = workspace.host_memory.empty(shape, np.uint8), math.prod(shape)
        with workspace.device_errors(f"rendering {name}"):
            after = self._completion_events()
            with workspace.lock:  # all images share the kernel object with its arguments
                kernel, values = _uint8_kernel(workspace)
                converted = workspace.pool.acquire(label, count)
                items = -(-count // (values * _UINT8_GROUP)) * _UINT8_GROUP
                arguments = np.uint64(count), np.uint64(index * count), self.buffer(name), converted
                event = kernel(workspace.read_queue, (items,), (_UINT8_GROUP,), *arguments, wait_for=after)
            try:
                cl.enqueue_copy(workspace.read_queue, into, converted, wait_for=[event])
            finally:
                workspace.pool.release([(label, converted)])
        return into

    def device_array(self, name: str, index: int | None = None) -> Any:
        if index is not None:
            return super().device_array(name, index)
        from pyopencl.array import Array

        shape, dtype = (self.view_count, *self._shape(name)), np.dtype(self._outputs[name].dtype)
        buffer: Any = cl.MemoryObject.from_int_ptr(self.buffer(name).int_ptr)
        # the array and its views keep these images alive, so that the pool does not reuse their buffers
        buffer.images = self
        return Array(self._workspace.queue, shape, dtype, data=buffer)

    def wait(self) -> None:
        with self._workspace.device_errors("rendering"):
            for part in self.ensure_complete():
                part.queue.finish()

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds by stage. For a replayed frame the first call renders it once more, with profiling."""
        with self._workspace.device_errors("rendering"):
            rendered = self.ensure_complete()
            if self._replay is not None and rendered[0].stages is None:
                with self._workspace.lock:
                    self._timings = self._timings or self._replay.timings()
                return self._timings
            return summed(part.timings() for part in (*rendered, *self._copied))

    @property
    def stats(self) -> Mapping[str, int]:
        """Number of splats of the cloud, and of visible splats and pairs of all views."""
        with self._workspace.device_errors("rendering"):
            stats = summed(part.stats() for part in self.ensure_complete())
            stats = {"splats": 0, "visible": 0, "pairs": 0} | stats | {"splats": self._splats}
            return summed([stats, *(copied.stats() for copied in self._copied)])

    def ensure_complete(self) -> list[Rendered]:
        """The rendered parts; a replayed frame that exceeded its capacity is rendered again."""
        if self._replay is not None:
            with self._workspace.lock:
                complete = self._replay.render_on_overflow(self._rendered[0])
                if complete is not None:
                    self._acquired += complete.acquired.items()
                    self._rendered = [complete]
        return self._rendered

    def termination_depths(self) -> TerminationDepths:
        """Termination depths of a frame with that effect. Raises DeviceError if the device has failed."""
        with self._workspace.device_errors("rendering"):
            (height, width), view = self._tile, self._view
            keys = np.empty((-(-view.height // height), -(-view.width // width)), np.uint32)
            (rendered,) = self.ensure_complete()
            queue, buffer = self._workspace.read_queue, rendered.acquired["termination_depths"]
            cl.enqueue_copy(queue, keys, buffer, wait_for=self._completion_events())
        return TerminationDepths.of_keys(keys, self._tile)

    def copy_tiles(self, other: OpenCLImages, tiles: np.ndarray) -> None:
        """Copy tiles of another frame of the same view. Raises DeviceError if the device has failed."""
        with self._workspace.device_errors("rendering"):
            after, copied = [*self._completion_events(), *other._completion_events()], None
            for output in self._outputs.values():
                width = 4 * output.channels  # bytes of a pixel
                row_bytes = self._size[1] * width
                source, target = other.buffer(output.name), self.buffer(output.name)
                for top, bottom, left, right in self._rectangles(tiles):
                    region, corner = ((right - left) * width, bottom - top, 1), (left * width, top, 0)
                    pitches = (row_bytes, row_bytes * self._size[0])
                    copied = cl.enqueue_copy(
                        *(self._workspace.read_queue, target, source),
                        **{"src_origin": corner, "dst_origin": corner, "region": region},
                        **{"src_pitches": pitches, "dst_pitches": pitches, "wait_for": after},
                    )
            if copied is not None:
                copied.wait()  # the next frame may overwrite the buffers of `other`
            (rendered,) = other.ensure_complete()
            self._copied.append(replace(rendered, acquired={}, stats=partial(dict, rendered.stats())))

    def _rectangles(self, tiles: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
        """Rectangles of pixels [top, bottom) x [left, right) that cover tiles (rows, columns) bool."""
        (rows, columns), (height, width) = self._size, (side // self._view.samples for side in self._tile)
        for row, mask in enumerate(tiles):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
            for first, end in edges.reshape(-1, 2).tolist():
                yield row * height, min((row + 1) * height, rows), first * width, min(end * width, columns)


def _uint8_kernel(workspace: Workspace) -> tuple[cl.Kernel, int]:
    if workspace not in _KERNELS:
        load_invoker()
        values = 16 if workspace.config.schedule == "lanes" else 4
        program = build(workspace, kernel_text("uint8.cl"), f"-DVALUES={values}")
        _KERNELS[workspace] = cl.Kernel(program, "to_uint8"), values
    return _KERNELS[workspace]
