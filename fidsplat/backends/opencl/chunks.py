"""Chunks of a scene in device buffers, and pictures that are drawn of some of them.

A buffer for each array has slots of one size. What a picture is drawn of is copied from there, on the device,
into arrays in the order of the scene, which decides ties of depth: so the picture has the bits of the whole.
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

from fidsplat.backends.interface import Chunk, ChunkCache, ChunkedScene, ResidentData
from fidsplat.backends.opencl.assemble import kernel_text
from fidsplat.backends.opencl.program import build
from fidsplat.backends.opencl.workspace import Workspace

_SHARE = 4
"""the cache takes at most this part of the memory budget"""
_WHOLE = 3
"""and what a picture is drawn of at most this, if it is put together as a whole"""
_FIRST_SLOTS = 16
_LAUNCH = 1 << 15
"""chunks of a launch: what every device takes as the second dimension of one"""
_NOWHERE = 0xFFFFFFFF


@dataclass(frozen=True)
class Copies:
    """What copies rows of chunks that have slots."""

    pieces: cl.Buffer
    """as `gather_chunks.cl` reads them"""
    poses: cl.Buffer | None
    count: int
    """chunks"""
    rows: int
    """of the chunk with most"""
    changes: int
    """of slots, before it was made"""


class OpenCLChunks(ChunkCache):
    """As `ChunkCache`."""

    def __init__(self, workspace: Workspace, whole: ChunkedScene, rows: int) -> None:
        self.workspace, self.whole, self._rows = workspace, whole, max(rows, 1)
        self.applies_poses = workspace.info.float64
        self.widths: dict[str, int] = {}
        """bytes of a splat in each array"""
        self._arrays: dict[str, cl.Buffer] = {}
        self._size = 0
        self._free: list[int] = []
        self._slots: OrderedDict[Hashable, int] = OrderedDict()
        """by chunk, least recently used first"""
        self.token = object()
        """what tells it from others, which is not to keep it"""
        self._changes = 0
        """how often a chunk has lost its slot"""
        self._drawn: set[Hashable] = set()
        self._lock = threading.RLock()
        self._queue = cl.CommandQueue(workspace.context)
        """for transfers, beside what is drawn"""
        self._last: cl.Event | None = None
        """the last copy out of slots"""
        program = build(
            workspace, kernel_text("store/gather_chunks.cl"), f"-DINSTANCED={int(self.applies_poses)}"
        )
        self._kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}

    @property
    def memory_bytes(self) -> int:
        """Bytes of all slots."""
        return self._size * self._rows * sum(self.widths.values())

    def gather(self, chunks: Sequence[Chunk], first_id: int = 0) -> GatheredChunks:
        """As `ChunkCache.gather`."""
        with self._lock:
            self._drawn = {chunk.key for chunk in chunks}
            if not self.widths:
                self._learn(chunks[0].load())
        return GatheredChunks(self, chunks, first_id)

    def bring(self, chunks: Sequence[Chunk]) -> None:
        """As `ChunkCache.bring`."""
        wanted = {chunk.key for chunk in chunks}  # one of these does not make room for another
        for chunk in chunks:
            with self._lock:
                if chunk.key in self._slots or not self.widths:
                    continue
            arrays = chunk.load()
            with self._lock:
                if chunk.key not in self._slots and not self._put(chunk.key, arrays, self._drawn | wanted):
                    return

    def copy(
        self, name: str, chunks: Sequence[Chunk], spans: np.ndarray, target: cl.Buffer, known: Copies | None
    ) -> Copies | None:
        """Rows of chunks to an array that a picture is drawn of, on the queue of pictures. spans: of each
        chunk (k, 3) its first row, where that goes, and how many rows. known: what this has returned for the
        same rows of another array."""
        with self._lock, self.workspace.failing("taking splats"):
            if known is not None and known.changes == self._changes:
                self._launch(name, known, target)
                return known
            rounds = list(self._rounds(chunks))
            copies = None
            for first, end in rounds:
                copies = self._copies(chunks[first:end], spans[first:end])
                self._launch(name, copies, target)
            return copies if len(rounds) == 1 else None

    def wait(self) -> None:
        """Until all copies are done."""
        with self._lock, self.workspace.failing("taking splats"):
            if self._last is not None:
                self._last.wait()

    def _rounds(self, chunks: Sequence[Chunk]) -> Iterator[tuple[int, int]]:
        """Ranges of chunks for all of which there are slots at once."""
        most, first, keys = self._most, 0, set()
        for number, chunk in enumerate(chunks):
            keys.add(chunk.key)
            if len(keys) > most or number - first == _LAUNCH:
                yield first, number
                first, keys = number, {chunk.key}
        yield first, len(chunks)

    def _copies(self, chunks: Sequence[Chunk], spans: np.ndarray) -> Copies:
        """How they are copied, once they are all there."""
        slots = self._there(chunks)
        table = np.full((len(chunks), 4), _NOWHERE, np.uint32)
        begins = np.array([chunk.first for chunk in chunks])
        table[:, 0] = np.array(slots) * self._rows + begins + spans[:, 0]
        table[:, 1:3] = spans[:, 1:]
        poses = [(number, chunk.pose) for number, chunk in enumerate(chunks) if chunk.pose is not None]
        table[[number for number, _ in poses], 3] = np.arange(len(poses))
        return Copies(
            pieces=self._sent(table),
            poses=self._sent(np.stack([pose for _, pose in poses])) if poses else None,
            count=len(chunks),
            rows=int(table[:, 2].max(initial=0)),
            changes=self._changes,
        )

    def _sent(self, array: np.ndarray) -> cl.Buffer:
        flags = cl.mem_flags
        return cl.Buffer(self.workspace.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=array)

    def _launch(self, name: str, copies: Copies, target: cl.Buffer) -> None:
        words = self.widths[name] // 4
        moves = copies.poses is not None and name in ("means", "quats")
        items = copies.rows * (1 if moves else words)
        if not items:
            return
        kernel = self._kernels[f"gather_{name}" if moves else "gather"]
        kernel.set_args(
            self._arrays[name], copies.pieces, copies.poses if moves else np.uint32(words), target
        )
        size = -(-items // 64) * 64, copies.count
        self._last = cl.enqueue_nd_range_kernel(self.workspace.queue, kernel, size, (64, 1))

    def _there(self, chunks: Sequence[Chunk]) -> list[int]:
        """The slots of chunks, for all of which there is room."""
        keys = {chunk.key for chunk in chunks}
        for chunk in chunks:
            if chunk.key in self._slots:
                self._slots.move_to_end(chunk.key)
            else:
                self._put(chunk.key, chunk.load(), keys)
        return [self._slots[chunk.key] for chunk in chunks]

    def _put(self, key: Hashable, arrays: Mapping[str, np.ndarray], kept: Collection[Hashable]) -> bool:
        """Brings a chunk to a slot; whether there was one that none of those has that are kept."""
        slot = self._slot(kept)
        if slot is None:
            return False
        try:
            for name, width in self.widths.items():
                if arrays[name].size:
                    array, place = np.ascontiguousarray(arrays[name]), slot * self._rows * width
                    cl.enqueue_copy(self._queue, self._arrays[name], array, dst_offset=place)
        except BaseException:
            self._free.append(slot)
            raise
        self._slots[key] = slot
        return True

    def _slot(self, kept: Collection[Hashable]) -> int | None:
        if not self._free and self._size < self._most:
            self._grow(min(self._most, max(_FIRST_SLOTS, 2 * self._size)))
        if self._free:
            return self._free.pop()
        oldest = next((key for key in self._slots if key not in kept), None)
        if oldest is None:
            return None
        if self._last is not None:
            self._last.wait()  # it may be read just now
        self._changes += 1
        return self._slots.pop(oldest)

    @property
    def reserved_bytes(self) -> int:
        """Bytes that slots may come to take: pictures leave room for all of them."""
        return self._most * self._slot_bytes

    @property
    def _slot_bytes(self) -> int:
        """Of a slot in all arrays, and once more in the widest: one that becomes larger is there twice for a
        while."""
        return self._rows * (sum(self.widths.values()) + max(self.widths.values()))

    @property
    def _most(self) -> int:
        """Slots, at most."""
        share = self.workspace.memory_budget // _SHARE // self._slot_bytes
        widest = self.workspace.device.max_mem_alloc_size // (self._rows * max(self.widths.values()))
        return max(1, self._size, min(share, widest, self.whole.distinct(self.applies_poses)))

    def _grow(self, size: int) -> None:
        if self._last is not None:
            self._last.wait()
        for name, width in self.widths.items():
            buffer = self.workspace.pool.fresh(f"chunks of {name}", size * self._rows * width)
            if self._size:
                held = self._size * self._rows * width
                # waited for one by one: where the next has no room, this one holds what it held
                cl.enqueue_copy(self._queue, buffer, self._arrays[name], byte_count=held).wait()
            self._arrays[name] = buffer
        self._free += range(size - 1, self._size - 1, -1)
        self._size = size

    def _learn(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, array in arrays.items():
            self.widths[name] = array.dtype.itemsize * int(np.prod(array.shape[1:], dtype=np.int64))


def _roomy(count: int) -> int:
    """At least as many, and at most an eighth more: one of a few numbers."""
    step = 1 << max(count.bit_length() - 4, 0)
    return -(-count // step) * step


class GatheredChunks(ResidentData):
    """What a picture is drawn of, as `Resident`: copied out of slots when a picture first asks for an array,
    or, where that would take more than its part of the memory budget, some splats at a time for every
    picture (`streamed`)."""

    def __init__(self, cache: OpenCLChunks, chunks: Sequence[Chunk], first_id: int) -> None:
        whole, workspace = cache.whole, cache.workspace
        self._cache, self._chunks, self._workspace = cache, chunks, workspace
        self._first_id = first_id
        self._ends = np.cumsum([chunk.count for chunk in chunks], dtype=np.int64)
        self.count = int(self._ends[-1])
        self.room = _roomy(self.count)
        """splats for which pictures have buffers: those of the next view, of about as many, are the same"""
        self.origin, self.sh_degree, self.footprint = whole.origin, whole.sh_degree, whole.footprint
        self.has_coplanar_groups, self.group_table = whole.has_coplanar_groups, whole.group_table
        self.ellipsoids = whole.ellipsoids
        self.cached_frames: dict[Hashable, Any] = {}
        """as that of a Resident"""
        self.fixed = True
        self.alike = cache.token
        self.neighbours = True
        self._buffers: dict[str, cl.Buffer] = {}
        self._leased: list[tuple[str, cl.Buffer]] = []
        weakref.finalize(self, workspace.pool.give_back, self._leased)
        self._copies: tuple[int, int, Copies | None] = (0, 0, None)
        """of splats [first, end), as they were copied last"""
        total, widest = self.room * sum(cache.widths.values()), self.room * max(cache.widths.values())
        self.streamed = (
            total > workspace.memory_budget // _WHOLE or widest > workspace.device.max_mem_alloc_size
        )

    def bytes_for(self, names: Iterable[str]) -> tuple[int, int]:
        """As that of a Resident: what the cache may take stays."""
        asked, stays = {*names, *self._buffers}, self._cache.reserved_bytes
        each = sum(self._width(name) for name in asked)
        return (stays, each) if self.streamed else (stays + self.room * each, 0)

    @property
    def memory_bytes(self) -> int:
        """Bytes on the device, the cache among them."""
        return self._cache.memory_bytes + sum(buffer.size for buffer in self._buffers.values())

    def part(self, name: str, first: int, end: int) -> cl.Buffer:
        """The array of splats [first, end)."""
        width = self._width(name)
        if self.streamed:
            buffer = self._workspace.pool.scratch(f"chunk of {name}", (end - first) * width)
            self._fill(name, first, end, buffer)
            return buffer
        if name not in self._buffers:
            # that of the last view, if it is large enough: to have new memory takes as long as to fill it
            label = f"the splats' {name}"
            whole = self._workspace.pool.lease(label, self.room * width, larger=True)
            self._leased.append((label, whole))
            self._fill(name, 0, self.count, whole)
            self._cache.wait()  # pictures may be drawn on another queue
            self._buffers[name] = whole
        whole = self._buffers[name]
        return (
            whole if end - first == self.count else whole.get_sub_region(first * width, (end - first) * width)
        )

    def _width(self, name: str) -> int:
        return 4 if name == "splat_ids" else self._cache.widths[name]

    def _fill(self, name: str, first: int, end: int, target: cl.Buffer) -> None:
        if first == end:
            return
        if name == "splat_ids":
            ids = self._first_id + np.arange(first, end, dtype=np.int32)
            cl.enqueue_copy(self._workspace.queue, target, ids)
            return
        lowest = int(np.searchsorted(self._ends, first, side="right"))
        highest = int(np.searchsorted(self._ends, end, side="left")) + 1
        ends = self._ends[lowest:highest]
        starts = ends - [chunk.count for chunk in self._chunks[lowest:highest]]
        begin, stop = np.maximum(starts, first), np.minimum(ends, end)
        spans = np.stack([begin - starts, begin - first, stop - begin], axis=1)
        begun, stopped, known = self._copies
        known = known if (begun, stopped) == (first, end) else None
        copies = self._cache.copy(name, self._chunks[lowest:highest], spans, target, known)
        self._copies = first, end, copies
