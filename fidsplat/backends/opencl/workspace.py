"""An open OpenCL device: its queues, its buffers and its memory budget."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache

import pyopencl as cl

from fidsplat.backends.interface import DeviceInfo
from fidsplat.backends.opencl.buffers import BufferPool, RayBuffers
from fidsplat.backends.opencl.host_memory import HostMemory
from fidsplat.backends.opencl.kernel_config import KernelConfig
from fidsplat.util.errors import DeviceError


@cache
def shared_context(device: cl.Device) -> cl.Context:
    """Context of a device, shared by its workspaces, since NVIDIA needs 0.3 s to create one."""
    return cl.Context([device])


class Workspace:
    """State of an open device: queues, buffers, memory budget and lock."""

    compiler_options: list[str]
    """of all programs"""

    def __init__(self, device: cl.Device, info: DeviceInfo, config: KernelConfig) -> None:
        self.device, self.info, self.config = device, info, config
        self.context = shared_context(device)
        self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        self.side_queue = cl.CommandQueue(self.context)
        """queue for counts that the host reads while the stages run"""
        self.read_queue = cl.CommandQueue(self.context)
        """queue for images that the host reads while the next frame is rendered"""
        self.replay_queue = cl.CommandQueue(self.context)
        """queue for replayed frames, without profiling: a launch takes the host a third less time"""
        self._last, self._idle = self.queue, True
        self.frames = 0
        """number of frames started; each overwrites the scratch buffers of the previous one"""
        self.lock = threading.RLock()
        """lock held while a frame is submitted, as frames share scratch buffers and kernel arguments"""
        self.pool = BufferPool(self.context, device)
        self.host_memory = HostMemory(self.context, device)
        self.ray_buffers = RayBuffers(self.pool, self.queue)
        self.limit_memory(info.memory_bytes * 9 // 10)

    def switch_to(self, queue: cl.CommandQueue) -> cl.CommandQueue:
        """Make later work on this queue wait for all work submitted to other queues."""
        if queue is not self._last:
            if not self._idle:
                before = cl.enqueue_marker(self._last)
                self._last.flush()
                cl.enqueue_barrier(queue, wait_for=[before])
            self._last = queue
        self._idle = False
        return queue

    def finish(self) -> None:
        """Wait for all submitted frames (with `lock` held)."""
        self._last.finish()
        self._idle = True

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """A context with exclusive use of the device. After an exception it waits for all queues, because
        kernels on a CPU may still read a cloud's host arrays.

        Raises DeviceError if an OpenCL call failed.
        """
        with self.lock:
            try:
                yield
            except BaseException as error:
                self.pool.invalidate_zeros()
                for queue in (self.queue, self.replay_queue):
                    with suppress(cl.Error):
                        queue.finish()
                if isinstance(error, cl.Error):
                    raise DeviceError(f"{self.info.title} failed while rendering: {error}") from error
                raise

    @contextmanager
    def device_errors(self, what: str) -> Iterator[None]:
        """A context that raises the device's failures as DeviceError. what: for example `rendering rgb`."""
        try:
            yield
        except cl.Error as error:
            raise DeviceError(f"{self.info.title} failed while {what}: {error}") from error

    def limit_memory(self, budget: int) -> None:
        """Limit a frame and its cloud to `budget` bytes of the device (memory_plan.py)."""
        self.memory_budget, self.largest_buffer = budget, self.device.max_mem_alloc_size
        """maximum bytes of a frame with its cloud, and of one buffer"""
        largest = self.largest_buffer // 8
        self.pair_budget = max(1, min(largest, budget // 8 // self.config.pair_bytes, 2**32 - 1))
        """maximum number of pairs of a splat and a tile in the lists at once"""
