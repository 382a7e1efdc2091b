"""The lists of splats per tile, in depth order, made in one of two ways.

On CPUs (`ordered`) all visible splats are sorted by depth, then listed per tile in that order, by counting
sorts over a few contiguous pieces: long sequential walks and no atomics. On GPUs (`tiled`) every splat counts
its tiles while it is projected, pairs are written to the tiles in any order, and each tile's list is sorted
in local memory: few launches, all of them wide. docs/growth.md has both on both kinds of device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.plan import BIG, KEYS, WINDOWS
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.opencl.run import Run

SPLAT_ARRAYS = ("means", "quats", "scales", "opacities")
"""what of a cloud every picture reads"""

# words of the buffer `tallies`, as in prelude.cl
_VISIBLE, _PAIRS, _ALL, _BIG, _TALLIES = 0, 2, 4, 6, 8
# words of the buffer `counts`, as in tiles.cl: big splats, pairs (two words)
_COUNTS = 3


class Lists:
    """What all ways share: the projection and its room for big splats."""

    def __init__(self, run: Run) -> None:
        self.run, self.shape = run, run.shape
        self.size = np.int32(run.view.width), np.int32(run.view.height)
        self.big = np.uint32(0)
        """big splats for which there is room"""

    def make_room(self, words: int, needed: int = 0) -> None:
        """Zeroes `words` words of the tallies; takes room for at least `needed` big splats."""
        run = self.run
        room = max(needed * 5 // 4, run.pool.size("big") // 4, BIG)
        self.big = np.uint32(room)
        tallies = run.lease("tallies", 4 * words)
        run.take("big", 4 * room)
        run.take("big bounds", run.pipeline.source.bounds_bytes * room)
        cl.enqueue_fill_buffer(run.queue, tallies, np.zeros(1, np.uint32), 0, 4 * words)

    def project(self, first: int, end: int) -> None:
        """Records, keys and windows of splats [first, end)."""
        run, count = self.run, end - first
        splats = run.take("splats", count * run.pipeline.source.record_bytes)
        keys, windows = run.take("keys", KEYS * count), run.take("windows", WINDOWS * count)
        if count == 0:
            return
        effects = run.pipeline.features.effects
        inputs = [(name, name in effect.view_inputs) for effect in effects for name in effect.inputs]
        arrays = [run.resident.part(name, first, end) for name in SPLAT_ARRAYS]
        extra = [
            run.held[name] if of_view else run.resident.part(name, first, end) for name, of_view in inputs
        ]
        big = (run.held["tallies"], self.big, run.held["big"], run.held["big bounds"])
        args = (np.uint32(count), run.held["view"], *arrays, splats, keys, windows, *big)
        run.launch("project", "project", count, 64, *args, *extra)


class OrderedLists(Lists):
    """Kernels scan.cl, sort.cl, bin.cl."""

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._stats: dict[str, int] = {}
        self._count = run.resident.count

    def stats(self) -> Callable[[], dict[str, int]]:
        """To be asked for after the last band, and called when splats, visible and pairs are wanted."""
        stats = self._stats
        return lambda: dict(stats)

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects and sorts; yields ranges of tiles (first, end), each when its lists are on the device."""
        run, words = self.run, np.zeros(_TALLIES, np.uint32)
        run.put_view(0, run.rows)
        while True:
            self.make_room(_TALLIES, int(words[_BIG]))
            self.project(0, self._count)
            self._sort()
            words = self._tally()
            if words[_BIG] <= self.big:
                break
        visible, pairs = (int(words[k]) | int(words[k + 1]) << 32 for k in (_VISIBLE, _PAIRS))
        self._stats = {"splats": run.resident.count, "visible": visible, "pairs": pairs}
        yield from self._list(0, run.tiles, pairs)

    def _list(self, first: int, end: int, pairs: int) -> Iterator[tuple[int, int]]:
        """Lists the tiles [first, end), in as many bands as the budget of pairs asks for."""
        run = self.run
        bands = [(first, end, pairs)]
        if pairs > run.backend.pair_budget:
            totals = run.read("bin totals", np.uint32, (run.tiles,))[first:end]
            bands = run.bands_of(totals, first)
        for start, stop, listed in bands:
            lists = run.take("lists", 4 * listed)
            band = (run.held["starts"], np.int32(start), np.int32(stop), np.uint32(listed))
            run.launch("bin", "bin_emit", self.shape.chunks, 1, *self._walk, *band, lists)
            yield start, stop

    def _sort(self) -> None:
        """Visible splats by depth, ties by index."""
        run = self.run
        count, bins = self._count, 1 << self.shape.radix_bits
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

    def _tally(self) -> np.ndarray:
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


class ChunkedLists(OrderedLists):
    """Kernels pack.cl beside those of OrderedLists: the cloud is projected a chunk at a time, and only what
    is seen is kept. If that is still too much, the picture is drawn in bands of rows of tiles, the whole
    cloud being projected for each. A tile's list is the same as ever, and so is the picture.
    """

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects and sorts; yields ranges of tiles (first, end), each when its lists are on the device."""
        run = self.run
        rows = [(0, run.tiles_y)]
        visible = pairs = 0
        while rows:
            top, end = rows.pop(0)
            needed, seen = self._gather(top, end)
            if needed > run.plan.capacity:
                rows[:0] = self._split(top, end, needed)
                continue
            visible = max(visible, seen)
            self._sort()
            self._tally()
            first, last = top * run.tiles_x, end * run.tiles_x
            totals = run.read("bin totals", np.uint32, (run.tiles,))[first:last]
            listed = int(totals.sum(dtype=np.int64))
            pairs += listed
            yield from self._list(first, last, listed)
        self._stats = {"splats": run.resident.count, "visible": visible, "pairs": pairs}

    def _split(self, top: int, end: int, needed: int) -> list[tuple[int, int]]:
        """A band in parts that each hold few enough splats, if they are spread evenly."""
        if end - top == 1:
            raise DeviceError(
                f"a row of tiles sees more than the {self.run.plan.capacity:,} splats for which the memory "
                "budget has room; raise memory_budget or draw fewer splats"
            )
        parts = min(max(2, -(-needed * 11 // (10 * self.run.plan.capacity))), end - top)
        cuts = np.linspace(top, end, parts + 1).round().astype(int).tolist()
        return list(pairwise(cuts))

    def _gather(self, top: int, end: int) -> tuple[int, int]:
        """Packs the splats of rows of tiles [top, end).

        Returns how many there are (an estimate if they are too many), and how many the picture shows.
        """
        run, height = self.run, self.shape.tile_height
        count, chunk, chunks = run.resident.count, run.plan.chunk, self.shape.chunks
        run.put_view(top * height, end * height)
        self.make_room(_TALLIES)
        source = run.pipeline.source
        packed = [
            run.take(f"packed {name}", size * run.plan.capacity)
            for name, size in (("splats", source.record_bytes), ("keys", KEYS), ("windows", WINDOWS))
        ]
        total = seen = 0
        for start in range(0, count, chunk):
            stop = min(start + chunk, count)
            self.project(start, stop)
            held = run.take("held", 8 * chunks)
            kept = (np.uint32(stop - start), run.held["keys"])
            run.launch("project", "pack_count", chunks, 1, *kept, held)
            counts = run.read("held", np.uint32, (2, chunks)).astype(np.int64)
            seen += int(counts[1].sum())
            places = np.concatenate([[0], np.cumsum(counts[0])]) + total
            total = int(places[-1])
            if total > run.plan.capacity:
                return -(-total * count // stop), seen
            if int(run.read("tallies", np.uint32, (_TALLIES,))[_BIG]) > self.big:
                self._more_room_for_big()
                return self._gather(top, end)
            where = run.put("places", places[:-1].astype(np.uint32))
            made = (run.held[name] for name in ("splats", "keys", "windows"))
            run.launch("project", "pack_move", chunks, 1, kept[0], where, *made, *packed)
        run.held |= dict(zip(("splats", "keys", "windows"), packed, strict=True))
        self._count = total
        return total, seen

    def _more_room_for_big(self) -> None:
        needed = int(self.run.read("tallies", np.uint32, (_TALLIES,))[_BIG])
        self.make_room(_TALLIES, 2 * needed)


class TiledLists(Lists):
    """Kernels tiles.cl. The buffers are as large as the last pictures needed, and all stages are launched
    before the host knows whether that is enough; if it is not, the lists are empty and it is all done again.
    """

    _ITEMS = 256  # WALK_ITEMS and SORT_ITEMS

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self._pairs = 0
        # work-groups that share out the splats of many tiles
        self._big_groups = 4 * run.backend.device.max_compute_units

    def stats(self) -> Callable[[], dict[str, int]]:
        """To be asked for after the last band, and called when splats, visible and pairs are wanted."""
        queue, tallies = self.run.queue, self.run.held["tallies"]
        splats, pairs = self.run.resident.count, self._pairs

        def read() -> dict[str, int]:
            words = np.empty(_TALLIES, np.uint32)
            cl.enqueue_copy(queue, words, tallies)
            return {"splats": splats, "visible": int(words[_VISIBLE]), "pairs": pairs}

        return read

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects; yields ranges of tiles (first, end), each when its lists are on the device."""
        run = self.run
        run.put_view(0, run.rows)
        capacity = min(run.pool.size("lists") // 4, run.pool.size("pairs") // 8, run.backend.pair_budget)
        self._project()
        counted = self._starts(capacity)
        if capacity:
            self._list(0, run.tiles, capacity, True)
            yield 0, run.tiles
        big, self._pairs = self._read(counted)
        while big > self.big:
            self._project(big)
            counted, capacity = self._starts(0), 0
            big, self._pairs = self._read(counted)
        if self._pairs > capacity or not capacity:
            yield from self._again()

    def _again(self) -> Iterator[tuple[int, int]]:
        """The lists in buffers that fit, in bands if need be."""
        run, budget = self.run, self.run.backend.pair_budget
        self._starts(2**32 - 1)
        bands = [(0, run.tiles, self._pairs)]
        if self._pairs > budget:
            tallies = run.read("tallies", np.uint32, (_TALLIES + run.tiles,))
            bands = run.bands_of(tallies[_TALLIES:])
        room = max(max(listed for _, _, listed in bands), min(self._pairs * 5 // 4, budget))
        for first, end, _ in bands:
            self._list(first, end, room, first == 0)
            yield first, end

    def _project(self, needed: int = 0) -> None:
        """Projects and tallies."""
        self.make_room(_TALLIES + self.run.tiles, needed)
        held = self.run.held
        self.project(0, self.run.resident.count)
        args = (*self.size, self.big, held["big bounds"], held["tallies"])
        self.run.launch("bin", "tally_big", self._big_groups * self._ITEMS, self._ITEMS, *args)

    def _starts(self, capacity: int) -> cl.Event:
        """Where each tile's list starts; all lists are empty if there are more pairs than `capacity`."""
        run, items = self.run, self.run.shape.scan_items
        starts = run.take("starts", 4 * (run.tiles + 1))
        cursors = run.take("cursors", 4 * run.tiles)
        # what the host reads has a buffer of its own: `emit` adds to the tallies meanwhile
        counts = run.take("counts", 4 * _COUNTS)
        args = (np.uint32(run.tiles), np.uint32(capacity), run.held["tallies"], starts, cursors, counts)
        return run.launch("bin", "tile_starts", items, items, *args)

    def _list(self, first: int, end: int, capacity: int, first_band: bool) -> None:
        """The sorted lists of the tiles of one band."""
        run, held, items = self.run, self.run.held, self._ITEMS
        pairs, lists = run.take("pairs", 8 * capacity), run.take("lists", 4 * capacity)
        groups = -(-run.resident.count // items)
        walk = (np.uint32(run.resident.count), np.uint32(groups), np.uint32(first_band), *self.size)
        band = (np.int32(first), np.int32(end), np.uint32(capacity), self.big)
        read = (
            held[name] for name in ("windows", "keys", "big", "big bounds", "starts", "tallies", "cursors")
        )
        run.launch("bin", "emit", (groups + self._big_groups) * items, items, *walk, *band, *read, pairs)
        sort = (np.int32(first), held["starts"], pairs, lists)
        run.launch("sort", "sort_tiles", (end - first) * items, items, *sort)

    def _read(self, counted: cl.Event) -> tuple[int, int]:
        """Numbers of big splats and of pairs as `counted` has left them, while later stages run."""
        words = np.empty(_COUNTS, np.uint32)
        self.run.queue.flush()
        side = self.run.backend.side_queue
        cl.enqueue_copy(side, words, self.run.held["counts"], wait_for=[counted])
        return int(words[0]), int(words[1]) | int(words[2]) << 32


LISTS = {"ordered": OrderedLists, "chunked": ChunkedLists, "tiled": TiledLists}
