"""Device chunk cache with prefetch: chunks of a scene in device buffers, and clouds gathered from them.

Each array has a buffer with slots of one size. A frame copies its chunks from the slots into arrays in scene
order. This order decides ties of depth, so images are bit-identical to those of the complete scene.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.interface import Chunk
from fidsplat.backends.opencl.assemble import kernel_text
from fidsplat.backends.opencl.cloud import OpenCLCloud
from fidsplat.backends.opencl.host_memory import rounded_up
from fidsplat.backends.opencl.program import build
from fidsplat.backends.opencl.workspace import Workspace

_CACHE_DIVISOR = 4
"""maximum size of the cache: the memory budget divided by this"""
_CLOUD_DIVISOR = 3
"""maximum size of a gathered cloud that is not streamed: the memory budget divided by this"""
_INITIAL_SLOTS = 16
_MAX_LAUNCH = 1 << 15
"""maximum number of chunks of a launch: the smallest limit of any device for the second dimension"""
_NO_POSE = 0xFFFFFFFF


@dataclass(frozen=True)
class CopyParameters:
    """Parameters of the kernels that copy rows of cached chunks."""

    table: cl.Buffer
    """the array `copies` of `gather_chunks.cl`"""
    poses: cl.Buffer | None
    count: int
    rows: int
    """number of rows of the largest chunk"""
    evictions: int
    """number of evictions when these parameters were computed; after another eviction they are invalid"""


class OpenCLChunkCache:
    """Device cache of a scene's chunks, bounded by the memory budget; the least recently used are evicted."""

    def __init__(self, workspace: Workspace, chunks: Any) -> None:
        """chunks: the `streaming.device_chunks.DeviceChunks` of a scene."""
        self.workspace, self.chunks, self._rows = workspace, chunks, max(chunks.largest_chunk, 1)
        self.applies_poses = workspace.info.float64
        """whether the device applies `Chunk.pose`; else it must be None"""
        self.row_bytes: dict[str, int] = {}
        """bytes per splat by the name of the array"""
        self._arrays: dict[str, cl.Buffer] = {}
        self._size = 0
        self._free: list[int] = []
        self._slots: OrderedDict[Hashable, int] = OrderedDict()
        """slot of each cached chunk by its key, least recently used first"""
        self.token = object()
        """identity that can be compared without keeping the cache alive"""
        self._evictions = 0
        self._rendered: set[Hashable] = set()
        self._lock = threading.RLock()
        self._queue = cl.CommandQueue(workspace.context)
        """queue of transfers that run while a frame is rendered"""
        self._last_copy: cl.Event | None = None
        """event of the last copy out of the cache"""
        program = build(
            workspace, kernel_text("store/gather_chunks.cl"), f"-DAPPLIES_POSES={int(self.applies_poses)}"
        )
        self._kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}

    @property
    def memory_bytes(self) -> int:
        return self._size * self._rows * sum(self.row_bytes.values())

    def gather(self, chunks: Sequence[Chunk], first_id: int = 0) -> GatheredChunks:
        """Concatenate chunks into one cloud; an array is copied when a frame first reads it. first_id:
        `splat_id` of the first splat."""
        with self._lock:
            self._rendered = {chunk.key for chunk in chunks}
            if not self.row_bytes:
                for name, array in chunks[0].load().items():
                    self.row_bytes[name] = array.itemsize * int(np.prod(array.shape[1:], dtype=np.int64))
        return GatheredChunks(self, chunks, first_id)

    def prefetch(self, chunks: Sequence[Chunk]) -> None:
        """Load chunks of the next frame from another thread, into free slots; evict only chunks that neither
        the current nor the next frame uses."""
        requested = {chunk.key for chunk in chunks}  # pinned: requested chunks must not evict each other
        for chunk in chunks:
            with self._lock:
                if chunk.key in self._slots or not self.row_bytes:
                    continue
            arrays = chunk.load()
            with self._lock:
                pinned = self._rendered | requested
                if chunk.key not in self._slots and not self._load(chunk.key, arrays, pinned):
                    return

    def copy(
        self,
        name: str,
        chunks: Sequence[Chunk],
        spans: np.ndarray,
        target: cl.Buffer,
        previous: CopyParameters | None,
    ) -> CopyParameters | None:
        """Copy rows of chunks into an array. spans: (k, 3) first row of each chunk, its destination, number
        of rows. previous: result of this method for the same rows of another array."""
        with self._lock, self.workspace.device_errors("copying splats"):
            if previous is not None and previous.evictions == self._evictions:
                self._launch(name, previous, target)
                return previous
            ranges = list(self._ranges(chunks))
            parameters = None
            for first, end in ranges:
                parameters = self._copy_parameters(chunks[first:end], spans[first:end])
                self._launch(name, parameters, target)
            return parameters if len(ranges) == 1 else None

    def wait(self) -> None:
        with self._lock, self.workspace.device_errors("copying splats"):
            if self._last_copy is not None:
                self._last_copy.wait()

    def _ranges(self, chunks: Sequence[Chunk]) -> Iterator[tuple[int, int]]:
        """Split chunks into ranges that fit the slots at once."""
        max_keys, first, keys = self._max_slots, 0, set()
        for index, chunk in enumerate(chunks):
            keys.add(chunk.key)
            if len(keys) > max_keys or index - first == _MAX_LAUNCH:
                yield first, index
                first, keys = index, {chunk.key}
        yield first, len(chunks)

    def _copy_parameters(self, chunks: Sequence[Chunk], spans: np.ndarray) -> CopyParameters:
        """Load chunks into slots, and return the parameters of their copies."""
        slots = self._load_missing(chunks)
        table = np.full((len(chunks), 4), _NO_POSE, np.uint32)
        first_rows = np.array([chunk.first for chunk in chunks])
        table[:, 0] = np.array(slots) * self._rows + first_rows + spans[:, 0]
        table[:, 1:3] = spans[:, 1:]
        poses = [(index, chunk.pose) for index, chunk in enumerate(chunks) if chunk.pose is not None]
        table[[index for index, _ in poses], 3] = np.arange(len(poses))
        return CopyParameters(
            table=self._constant(table),
            poses=self._constant(np.stack([pose for _, pose in poses])) if poses else None,
            count=len(chunks),
            rows=int(table[:, 2].max(initial=0)),
            evictions=self._evictions,
        )

    def _constant(self, array: np.ndarray) -> cl.Buffer:
        flags = cl.mem_flags
        return cl.Buffer(self.workspace.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=array)

    def _launch(self, name: str, parameters: CopyParameters, target: cl.Buffer) -> None:
        words = self.row_bytes[name] // 4
        posed = parameters.poses is not None and name in ("means", "quats")
        items = parameters.rows * (1 if posed else words)
        if not items:
            return
        kernel = self._kernels["gather_posed" if posed else "gather"]
        poses = (parameters.poses,) if posed else ()
        kernel.set_args(self._arrays[name], parameters.table, np.uint32(words), *poses, target)
        size = -(-items // 64) * 64, parameters.count
        self._last_copy = cl.enqueue_nd_range_kernel(self.workspace.queue, kernel, size, (64, 1))

    def _load_missing(self, chunks: Sequence[Chunk]) -> list[int]:
        """Load chunks that are not cached, and return the slots of all."""
        keys = {chunk.key for chunk in chunks}
        for chunk in chunks:
            if chunk.key in self._slots:
                self._slots.move_to_end(chunk.key)
            else:
                self._load(chunk.key, chunk.load(), keys)
        return [self._slots[chunk.key] for chunk in chunks]

    def _load(self, key: Hashable, arrays: Mapping[str, np.ndarray], pinned: Collection[Hashable]) -> bool:
        """Load a chunk into a slot. Returns False if all slots have pinned chunks."""
        slot = self._slot(pinned)
        if slot is None:
            return False
        try:
            for name, row_bytes in self.row_bytes.items():
                if arrays[name].size:
                    array, offset = np.ascontiguousarray(arrays[name]), slot * self._rows * row_bytes
                    cl.enqueue_copy(self._queue, self._arrays[name], array, dst_offset=offset)
        except BaseException:
            self._free.append(slot)
            raise
        self._slots[key] = slot
        return True

    def _slot(self, pinned: Collection[Hashable]) -> int | None:
        if not self._free and self._size < self._max_slots:
            self._grow(min(self._max_slots, max(_INITIAL_SLOTS, 2 * self._size)))
        if self._free:
            return self._free.pop()
        oldest = next((key for key in self._slots if key not in pinned), None)
        if oldest is None:
            return None
        if self._last_copy is not None:
            self._last_copy.wait()  # a kernel may be reading it
        self._evictions += 1
        return self._slots.pop(oldest)

    @property
    def reserved_bytes(self) -> int:
        """Bytes of the slots when the cache is full."""
        return self._max_slots * self._slot_bytes

    @property
    def _slot_bytes(self) -> int:
        """Bytes of a slot. The widest array counts twice, as it exists twice while the cache grows."""
        return self._rows * (sum(self.row_bytes.values()) + max(self.row_bytes.values()))

    @property
    def _max_slots(self) -> int:
        fitting = self.workspace.memory_budget // _CACHE_DIVISOR // self._slot_bytes
        allocatable = self.workspace.device.max_mem_alloc_size // (self._rows * max(self.row_bytes.values()))
        chunks = self.chunks.count_distinct(self.applies_poses)
        return max(1, self._size, min(fitting, allocatable, chunks))

    def _grow(self, size: int) -> None:
        if self._last_copy is not None:
            self._last_copy.wait()
        for name, row_bytes in self.row_bytes.items():
            buffer = self.workspace.pool.allocate(f"chunks of {name}", size * self._rows * row_bytes)
            if self._size:
                used = self._size * self._rows * row_bytes
                # arrays grow one by one: if an allocation fails, the others are still complete
                cl.enqueue_copy(self._queue, buffer, self._arrays[name], byte_count=used).wait()
            self._arrays[name] = buffer
        self._free += range(size - 1, self._size - 1, -1)
        self._size = size


class GatheredChunks(OpenCLCloud):
    """A cloud assembled from cached chunks; `streamed` if it exceeds its fraction of the memory budget."""

    is_spatially_sorted = True

    def __init__(self, cache: OpenCLChunkCache, chunks: Sequence[Chunk], first_id: int) -> None:
        workspace = cache.workspace
        self._cache, self._chunks, self._workspace = cache, chunks, workspace
        self._first_id, self.buffer_key = first_id, cache.token
        self._ends = np.cumsum([chunk.count for chunk in chunks], dtype=np.int64)
        super().__init__(int(self._ends[-1]))
        self.copy_properties(cache.chunks.scene)
        self.padded_count = rounded_up(self.count, 4)  # so that the next view reuses the buffers
        self._acquired: list[tuple[str, cl.Buffer]] = []
        weakref.finalize(self, workspace.pool.release, self._acquired)
        self._previous_copy: tuple[int, int, CopyParameters | None] = (0, 0, None)
        """the last copy: its splats [first, end), and its parameters"""
        row_bytes = cache.row_bytes.values()
        total, widest = self.padded_count * sum(row_bytes), self.padded_count * max(row_bytes)
        self.streamed = (
            total > workspace.memory_budget // _CLOUD_DIVISOR or widest > workspace.device.max_mem_alloc_size
        )

    def bytes_for(self, names: Iterable[str]) -> tuple[int, int]:
        """Bytes of these arrays and of the full cache on the device, and bytes per splat copied for each
        frame."""
        splat_bytes = sum(self._row_bytes(name) for name in {*names, *self._buffers})
        cache_bytes = self._cache.reserved_bytes
        return (
            (cache_bytes, splat_bytes)
            if self.streamed
            else (cache_bytes + self.padded_count * splat_bytes, 0)
        )

    @property
    def memory_bytes(self) -> int:
        return self._cache.memory_bytes + super().memory_bytes

    def array_in_cloud_order(self, name: str, first: int, end: int) -> cl.Buffer:
        row_bytes = self._row_bytes(name)
        if self.streamed:
            buffer = self._workspace.pool.scratch(f"slice of {name}", (end - first) * row_bytes)
            self._fill(name, first, end, buffer)
            return buffer
        if name not in self._buffers:
            # the buffer of the previous view is reused if large enough: allocating takes as long as filling
            label = f"the splats' {name}"
            buffer = self._workspace.pool.acquire(label, self.padded_count * row_bytes, larger=True)
            self._acquired.append((label, buffer))
            self._fill(name, 0, self.count, buffer)
            self._cache.wait()  # frames may be rendered on another queue
            self._buffers[name] = buffer
        return self._region(self._buffers[name], first, end, row_bytes)

    def _row_bytes(self, name: str) -> int:
        return 4 if name == "splat_ids" else self._cache.row_bytes[name]

    def _fill(self, name: str, first: int, end: int, target: cl.Buffer) -> None:
        if first == end:
            return
        if name == "splat_ids":
            ids = self._first_id + np.arange(first, end, dtype=np.int32)
            cl.enqueue_copy(self._workspace.queue, target, ids)
            return
        overlapping = slice(
            int(np.searchsorted(self._ends, first, side="right")),
            int(np.searchsorted(self._ends, end, side="left")) + 1,
        )
        chunks, ends = self._chunks[overlapping], self._ends[overlapping]
        starts = ends - [chunk.count for chunk in chunks]
        from_splat, to_splat = np.maximum(starts, first), np.minimum(ends, end)
        spans = np.stack([from_splat - starts, from_splat - first, to_splat - from_splat], axis=1)
        *previous_range, previous = self._previous_copy
        if previous_range != [first, end]:
            previous = None
        self._previous_copy = first, end, self._cache.copy(name, chunks, spans, target, previous)
