"""The lists of splats per tile, in depth order, made in one of two ways.

On CPUs (`ordered`) all visible splats are sorted by depth, then listed per tile in that order, by counting
sorts over a few contiguous pieces: long sequential walks and no atomics. On GPUs (`tiled`) every splat counts
its tiles while it is projected, pairs are written to the tiles in any order, and each tile's list is sorted
in local memory: few launches, all of them wide. docs/performance.md has both on both kinds of device.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

if TYPE_CHECKING:
    from fidsplat.backends.opencl.run import Run

# words of the buffer `tallies`, as in prelude.cl
_VISIBLE, _PAIRS, _ALL, _BIG, _TALLIES = 0, 2, 4, 6, 8


class Lists:
    """What both ways share: the projection and its room for big splats."""

    def __init__(self, run: Run) -> None:
        self.run, self.shape = run, run.shape
        self.size = np.int32(run.view.width), np.int32(run.view.height)
        self.big = np.uint32(0)
        """big splats for which there is room"""

    def project(self, words: int, needed: int = 0) -> None:
        """Zeroes `words` words of the tallies and projects every splat."""
        run = self.run
        room = max(needed * 5 // 4, run.pool.size("big") // 4, 4096)
        self.big = np.uint32(room)
        tallies = run.take("tallies", 4 * words)
        windows = run.take("windows", 8 * run.resident.count)
        big, bounds = (
            run.take("big", 4 * room),
            run.take("big bounds", run.pipeline.source.bounds_bytes * room),
        )
        cl.enqueue_fill_buffer(run.queue, tallies, np.zeros(1, np.uint32), 0, 4 * words)
        run.project(windows, tallies, self.big, big, bounds)


class OrderedLists(Lists):
    """Kernels scan.cl, sort.cl, bin.cl."""

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._stats: dict[str, int] = {}

    def stats(self) -> dict[str, int]:
        """splats, visible, pairs."""
        return self._stats

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects and sorts; yields ranges of tiles (first, end), each when its lists are on the device."""
        run, words = self.run, np.zeros(_TALLIES, np.uint32)
        while True:
            self.project(_TALLIES, int(words[_BIG]))
            self._sort()
            words = self._count()
            if words[_BIG] <= self.big:
                break
        visible, pairs = (int(words[k]) | int(words[k + 1]) << 32 for k in (_VISIBLE, _PAIRS))
        self._stats = {"splats": run.resident.count, "visible": visible, "pairs": pairs}
        bands = [(0, run.tiles, pairs)]
        if pairs > run.backend.pair_budget:
            bands = run.bands_of(run.read("bin totals", np.uint32, (run.tiles,)))
        for first, end, listed in bands:
            lists = run.take("lists", 4 * listed)
            band = (run.held["starts"], np.int32(first), np.int32(end), np.uint32(listed))
            run.launch("bin", "bin_emit", self.shape.chunks, 1, *self._walk, *band, lists)
            yield first, end

    def _sort(self) -> None:
        """Visible splats by depth, ties by index."""
        run = self.run
        count, bins = run.resident.count, 1 << self.shape.radix_bits
        table = run.take("sort table", 4 * bins * self.shape.chunks)
        keys, order, tallies = run.held["keys"], run.take("order 0", 4 * count), run.held["tallies"]
        length = np.array([count, 0], np.uint32)
        run.uploads.append(
            cl.enqueue_copy(run.queue, tallies, length, dst_offset=4 * _ALL, is_blocking=False)
        )
        for number, shift in enumerate(range(0, 32, self.shape.radix_bits)):
            slot = np.uint32(_ALL if number == 0 else _VISIBLE)
            keys_out = run.take(f"sorted keys {number % 2}", 4 * count)
            order_out = run.take(f"order {(number + 1) % 2}", 4 * count)
            digit = (tallies, slot, np.uint32(shift))
            run.launch("sort", "sort_count", self.shape.chunks, 1, keys, *digit, table)
            starts = self._starts("sort", table, bins, _VISIBLE)
            args = (keys, order, *digit, np.uint32(number == 0), table, starts)
            run.launch("sort", "sort_scatter", self.shape.chunks, 1, *args, keys_out, order_out)
            keys, order = keys_out, order_out
        run.held["order"] = order

    def _count(self) -> np.ndarray:
        """Lengths of the tiles' lists; returns the tallies."""
        run = self.run
        table = run.take("bin table", 4 * run.tiles * self.shape.chunks)
        held = (run.held[name] for name in ("order", "tallies", "windows"))
        self._walk = (*held, self.big, run.held["big bounds"], *self.size, table)
        run.launch("bin", "bin_count", self.shape.chunks, 1, *self._walk)
        run.held["starts"] = self._starts("bin", table, run.tiles, _PAIRS)
        return run.read("tallies", np.uint32, (_TALLIES,))

    def _starts(self, stage: str, table: cl.Buffer, bins: int, slot: int) -> cl.Buffer:
        """Turns a table of counts into places: returns where each bin starts (bins + 1)."""
        run = self.run
        totals = run.take(f"{stage} totals", 4 * bins)
        starts = run.take(f"{stage} starts", 4 * (bins + 1))
        items = self.shape.scan_items
        run.launch(stage, "scan_chunks", bins, 64, np.uint32(bins), table, totals)
        scan = (np.uint32(bins), totals, starts, run.held["tallies"], np.uint32(slot))
        run.launch(stage, "scan_bins", items, items, *scan)
        return starts


class TiledLists(Lists):
    """Kernels tiles.cl. The buffers are as large as the last pictures needed, and the stages are launched
    before the host knows whether that is enough; if it is not, the lists are empty and it is all done again.
    """

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._pairs = 0
        self._visible: tuple[np.ndarray, cl.Event] | None = None

    def stats(self) -> dict[str, int]:
        """splats, visible, pairs."""
        visible = 0
        if self._visible is not None:
            words, event = self._visible
            event.wait()
            visible = int(words[_VISIBLE])
        return {"splats": self.run.resident.count, "visible": visible, "pairs": self._pairs}

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects; yields ranges of tiles (first, end), each when its lists are on the device."""
        run = self.run
        capacity = min(run.pool.size("lists") // 4, run.pool.size("pairs") // 8, run.backend.pair_budget)
        self._project()
        counted = self._starts(capacity)
        if capacity:
            self._list(0, run.tiles, capacity, True)
            yield 0, run.tiles
        words = self._read(counted)
        while words[_BIG] > self.big:
            self._project(int(words[_BIG]))
            counted, capacity = self._starts(0), 0
            words = self._read(counted)
        self._pairs = int(words[_PAIRS]) | int(words[_PAIRS + 1]) << 32
        if self._pairs > capacity or not capacity:
            yield from self._again()
        # the number of visible splats is complete only now; nobody may ask
        tallies = np.empty(_TALLIES, np.uint32)
        self._visible = tallies, cl.enqueue_copy(run.queue, tallies, run.held["tallies"], is_blocking=False)

    def _again(self) -> Iterator[tuple[int, int]]:
        """The lists in buffers that fit, in bands if need be."""
        run, budget = self.run, self.run.backend.pair_budget
        self._starts(2**32 - 1)
        bands = [(0, run.tiles, self._pairs)]
        if self._pairs > budget:
            tallies = run.read("tallies", np.uint32, (_TALLIES + run.tiles,))
            bands = run.bands_of(tallies[_TALLIES:])
        room = max(max(listed for _, _, listed in bands), min(self._pairs * 5 // 4, budget))
        run.take("pairs", 8 * room)
        run.take("lists", 4 * room)
        for first, end, _ in bands:
            self._list(first, end, room, first == 0)
            yield first, end

    def _project(self, needed: int = 0) -> None:
        """Projects and tallies."""
        self.project(_TALLIES + self.run.tiles, needed)
        held = self.run.held
        self._launch_big("tally_big", *self.size, self.big, held["big bounds"], held["tallies"])

    def _starts(self, capacity: int) -> cl.Event:
        """Where each tile's list starts; all lists are empty if there are more pairs than `capacity`."""
        run, items = self.run, self.run.shape.scan_items
        starts = run.take("starts", 4 * (run.tiles + 1))
        cursors = run.take("cursors", 4 * run.tiles)
        args = (np.uint32(run.tiles), np.uint32(capacity), run.held["tallies"], starts, cursors)
        return run.launch("bin", "tile_starts", items, items, *args)

    def _list(self, first: int, end: int, capacity: int, first_band: bool) -> None:
        """The sorted lists of the tiles of one band."""
        run, held = self.run, self.run.held
        pairs, lists = run.take("pairs", 8 * capacity), run.take("lists", 4 * capacity)
        band = (np.int32(first), np.int32(end), np.uint32(capacity))
        places = (held["starts"], held["tallies"], held["cursors"], pairs)
        count = run.resident.count
        if count:
            walk = (np.uint32(count), np.uint32(first_band), np.int32(run.tiles_x), *band)
            run.launch("bin", "emit", count, 256, *walk, held["windows"], held["keys"], *places)
        bounds = (held["big"], held["big bounds"], held["keys"])
        self._launch_big("emit_big", *self.size, *band, self.big, *bounds, *places)
        sort = (np.int32(first), held["starts"], pairs, lists)
        run.launch("sort", "sort_tiles", (end - first) * 256, 256, *sort)

    def _read(self, counted: cl.Event) -> np.ndarray:
        """The tallies' head as it was when `counted` had ended, while later stages run."""
        words = np.empty(_TALLIES, np.uint32)
        self.run.queue.flush()
        side = self.run.backend.side_queue
        cl.enqueue_copy(side, words, self.run.held["tallies"], wait_for=[counted])
        return words

    def _launch_big(self, kernel: str, *args) -> None:
        groups = 4 * self.run.backend.device.max_compute_units
        self.run.launch("bin", kernel, groups * 128, 128, *args)


LISTS = {"ordered": OrderedLists, "tiled": TiledLists}
