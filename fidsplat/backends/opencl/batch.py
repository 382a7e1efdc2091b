"""Many views of one cloud on an OpenCL device: parts of as many as memory holds, each one submission."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import BatchImages, summed
from fidsplat.backends.opencl.images import Rendered
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.effects.catalogue import Output
from fidsplat.util.errors import DeviceError, bytes_words


class OutputBuffers:
    """The output images of all views of a batch, (views, h, w, channels) each."""

    def __init__(self, workspace: Workspace, outputs: tuple[Output, ...], batch: ViewBatch) -> None:
        """
        Raises:
            DeviceError: they take more than the memory budget, or one more than the device gives at once.
        """
        self.outputs = {output.name: output for output in outputs}
        views, size = batch.total, batch.size
        self.views, self.size = views, size
        bytes_of = {one.name: 4 * views * size[0] * size[1] * one.channels for one in outputs}
        self.nbytes = sum(bytes_of.values())
        largest, most = max(bytes_of, key=bytes_of.__getitem__), workspace.device.max_mem_alloc_size
        if bytes_of[largest] > most:
            raise DeviceError(
                f"{largest} of {views} views takes {bytes_words(bytes_of[largest])} in one piece, and the "
                f"device gives at most {bytes_words(most)}; draw fewer views at once"
            )
        if self.nbytes > workspace.memory_budget:
            raise DeviceError(
                f"the images of {views} views take {bytes_words(self.nbytes)}, more than the memory "
                f"budget of {bytes_words(workspace.memory_budget)}; draw fewer views or outputs at once"
            )
        lease = workspace.pool.lease
        self.leased = [
            (f"{name} of views", lease(f"{name} of views", size)) for name, size in bytes_of.items()
        ]
        for (_, buffer), output in zip(self.leased, outputs, strict=True):
            if len(batch.slots) < views:
                pattern = np.full(1, output.blank, output.dtype)
                cl.enqueue_fill_buffer(workspace.queue, buffer, pattern, 0, bytes_of[output.name])

    def held(self) -> dict[str, cl.Buffer]:
        """By the names of the kernels' arguments."""
        return {f"{name.removesuffix(' of views')}_out": buffer for name, buffer in self.leased}

    def shape(self, name: str) -> tuple[int, ...]:
        """Of an image of one view."""
        channels = self.outputs[name].channels
        return self.size if channels == 1 else (*self.size, channels)


class OpenCLBatch(BatchImages):
    """Finished images of many views on the device."""

    shares_arrays = True

    def __init__(
        self, workspace: Workspace, buffers: OutputBuffers, rendered: list[Rendered], splats: int
    ) -> None:
        self._workspace, self._buffers, self._rendered, self._splats = workspace, buffers, rendered, splats
        self.views = buffers.views
        leased = [*buffers.leased, *(each for one in rendered for each in one.leased)]
        weakref.finalize(self, workspace.pool.give_back, leased)

    def read(self, name: str) -> np.ndarray:
        """(views, h, w) or (views, h, w, channels); waits for the device."""
        shape = self.views, *self._buffers.shape(name)
        return self._read(name, np.empty(shape, self._buffers.outputs[name].dtype), 0)

    def read_one(self, name: str, number: int) -> np.ndarray:
        """The image of one view."""
        image = np.empty(self._buffers.shape(name), self._buffers.outputs[name].dtype)
        return self._read(name, image, number * image.nbytes)

    def _read(self, name: str, image: np.ndarray, offset: int) -> np.ndarray:
        with self._workspace.failing(f"rendering {name}"):
            buffer = self._buffers.held()[f"{name}_out"]
            cl.enqueue_copy(self._workspace.queue, image, buffer, src_offset=offset)
        return image

    def device_array(self, name: str) -> Any:
        """The images as a pyopencl.array.Array (views, h, w) or (views, h, w, channels); no copy."""
        from pyopencl.array import Array

        buffers = self._buffers
        shape, dtype = (self.views, *buffers.shape(name)), np.dtype(buffers.outputs[name].dtype)
        buffer: Any = cl.MemoryObject.from_int_ptr(buffers.held()[f"{name}_out"].int_ptr)
        # not given to another batch while this array lives, or a part of it: all of them hold this object
        buffer.batch = self
        return Array(self._workspace.queue, shape, dtype, data=buffer)

    def wait(self) -> None:
        """Until the device has drawn all views."""
        with self._workspace.failing("rendering"):
            self._workspace.queue.finish()

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds by stage, of all views together."""
        return summed([one.timings() for one in self._rendered])

    @property
    def stats(self) -> Mapping[str, int]:
        return (
            {"visible": 0, "pairs": 0}
            | summed([one.stats() for one in self._rendered])
            | {"splats": self._splats}
        )
