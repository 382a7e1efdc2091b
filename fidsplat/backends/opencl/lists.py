"""The lists of splats per tile, in depth order, made in one of two ways.

On CPUs (`ordered`) all visible splats are sorted by depth, then listed per tile in that order, by counting
sorts over a few contiguous pieces: long sequential walks and no atomics. On GPUs (`tiled`) every splat counts
its tiles while it is projected, pairs are written to the tiles in any order, and each tile's list is sorted
in local memory: few launches, all of them wide. docs/growth.md has both on both kinds of device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pyopencl as cl

from fidsplat.backends.bands import cut
from fidsplat.backends.opencl.memory_plan import BIG, KEYS, WINDOWS
from fidsplat.backends.opencl.picture import Picture
from fidsplat.errors import DeviceError

# words of the buffer `tallies`, as in prelude.cl
_VISIBLE, _PAIRS, _ALL, _BIG, _TALLIES = 0, 2, 4, 6, 8
# words of the buffer `counts`, as in tiles.cl: big splats, pairs (two words)
_COUNTS = 3


class Lists:
    """What all ways share: the projection and its room for big splats."""

    def __init__(self, picture: Picture) -> None:
        self.picture, self.shape = picture, picture.shape
        self.big = 0
        """big splats for which there is room"""

    def make_room(self, words: int, needed: int = 0) -> None:
        """Zeroes `words` words of the tallies; takes room for at least `needed` big splats."""
        picture = self.picture
        self.big = max(needed * 5 // 4, picture.pool.size("big") // 4, BIG)
        picture.held["big_capacity"] = self.big
        tallies = picture.lease("tallies", 4 * words)
        picture.take("big", 4 * self.big)
        picture.take("big_bounds", picture.program.source.records["Bounds"].itemsize * self.big)
        cl.enqueue_fill_buffer(picture.queue, tallies, np.zeros(1, np.uint32), 0, 4 * words)

    def project(self, first: int, end: int) -> None:
        """Records, keys and windows of splats [first, end)."""
        picture, count = self.picture, end - first
        source = picture.program.source
        picture.take("splats", count * source.records["Splat"].itemsize)
        picture.take("keys", KEYS * count)
        picture.take("windows", WINDOWS * count)
        if count == 0:
            return
        wanted = [one.name for one in source.arguments["project"] if one.source == "cloud"]
        arrays = {name: picture.resident.part(name, first, end) for name in wanted}
        picture.launch("project", "project", count, 64, count=count, **arrays)


class OrderedLists(Lists):
    """Kernels scan.cl, sort.cl, bin.cl."""

    def __init__(self, picture: Picture) -> None:
        super().__init__(picture)
        self._stats: dict[str, int] = {}
        self._count = picture.resident.count

    def stats(self) -> Callable[[], dict[str, int]]:
        """To be asked for after the last band, and called when splats, visible and pairs are wanted."""
        stats = self._stats
        return lambda: dict(stats)

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects and sorts; yields ranges of tiles (first, end), each when its lists are on the device."""
        picture, words = self.picture, np.zeros(_TALLIES, np.uint32)
        picture.put_view(0, picture.rows)
        while True:
            self.make_room(_TALLIES, int(words[_BIG]))
            self.project(0, self._count)
            self._sort()
            words = self._tally()
            if words[_BIG] <= self.big:
                break
        visible, pairs = (int(words[k]) | int(words[k + 1]) << 32 for k in (_VISIBLE, _PAIRS))
        self._stats = {"splats": picture.resident.count, "visible": visible, "pairs": pairs}
        yield from self._list(0, picture.tiles, pairs)

    def _list(self, first: int, end: int, pairs: int) -> Iterator[tuple[int, int]]:
        """Lists the tiles [first, end), in as many bands as the budget of pairs asks for."""
        picture = self.picture
        bands = [(first, end, pairs)]
        if pairs > picture.workspace.pair_budget:
            totals = picture.read("bin totals", np.uint32, (picture.tiles,))[first:end]
            bands = cut(totals, picture.workspace.pair_budget, first)
        for start, stop, listed in bands:
            picture.take("lists", 4 * listed)
            band = {"band_first": start, "band_end": stop}
            picture.launch("bin", "bin_emit", self.shape.chunks, 1, table=picture.held["bin table"], **band)
            yield start, stop

    def _sort(self) -> None:
        """Visible splats by depth, ties by index."""
        picture = self.picture
        count, bins = self._count, 1 << self.shape.radix_bits
        table = picture.take("sort table", 4 * bins * self.shape.chunks)
        keys, order = picture.held["keys"], picture.take("order 0", 4 * count)
        length = np.array([count, 0], np.uint32)
        copied = cl.enqueue_copy(
            picture.queue, picture.held["tallies"], length, dst_offset=4 * _ALL, is_blocking=False
        )
        picture.uploads.append(copied)
        for number, shift in enumerate(range(0, 32, self.shape.radix_bits)):
            keys_out = picture.take(f"sorted keys {number % 2}", 4 * count)
            order_out = picture.take(f"order {(number + 1) % 2}", 4 * count)
            digit = {"keys": keys, "slot": _VISIBLE if number else _ALL, "shift": shift, "table": table}
            picture.launch("sort", "sort_count", self.shape.chunks, 1, **digit)
            digit |= {"starts": self._starts("sort", table, bins, _VISIBLE), "indices": order}
            out = {"keys_out": keys_out, "indices_out": order_out}
            picture.launch("sort", "sort_scatter", self.shape.chunks, 1, first=number == 0, **digit, **out)
            keys, order = keys_out, order_out
        picture.held["order"] = order

    def _tally(self) -> np.ndarray:
        """Lengths of the tiles' lists; returns the tallies."""
        picture = self.picture
        table = picture.take("bin table", 4 * picture.tiles * self.shape.chunks)
        picture.launch("bin", "bin_count", self.shape.chunks, 1, table=table)
        picture.held["starts"] = self._starts("bin", table, picture.tiles, _PAIRS)
        return picture.read("tallies", np.uint32, (_TALLIES,))

    def _starts(self, stage: str, table: cl.Buffer, bins: int, slot: int) -> cl.Buffer:
        """Turns a table of counts into places: returns where each bin starts (bins + 1)."""
        picture = self.picture
        totals = picture.take(f"{stage} totals", 4 * bins)
        starts = picture.take(f"{stage} starts", 4 * (bins + 1))
        items, scan = self.shape.scan_items, {"bins": bins, "totals": totals}
        picture.launch(stage, "scan_chunks", bins, 64, table=table, **scan)
        picture.launch(stage, "scan_bins", items, items, starts=starts, slot=slot, **scan)
        return starts


class ChunkedLists(OrderedLists):
    """Kernels pack.cl beside those of OrderedLists: the cloud is projected a chunk at a time, and only what
    is seen is kept. If that is still too much, the picture is drawn in bands of rows of tiles, the whole
    cloud being projected for each. A tile's list is the same as ever, and so is the picture.
    """

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects and sorts; yields ranges of tiles (first, end), each when its lists are on the device."""
        picture = self.picture
        rows = [(0, picture.tiles_y)]
        visible = pairs = 0
        while rows:
            top, end = rows.pop(0)
            needed, seen = self._gather(top, end)
            if needed > picture.plan.capacity:
                rows[:0] = self._split(top, end, needed)
                continue
            visible = max(visible, seen)
            self._sort()
            self._tally()
            first, last = top * picture.tiles_x, end * picture.tiles_x
            totals = picture.read("bin totals", np.uint32, (picture.tiles,))[first:last]
            listed = int(totals.sum(dtype=np.int64))
            pairs += listed
            yield from self._list(first, last, listed)
        self._stats = {"splats": picture.resident.count, "visible": visible, "pairs": pairs}

    def _split(self, top: int, end: int, needed: int) -> list[tuple[int, int]]:
        """A band in parts that each hold few enough splats, if they are spread evenly."""
        if end - top == 1:
            raise DeviceError(
                f"a row of tiles sees more than the {self.picture.plan.capacity:,} splats for which the "
                "memory budget has room; raise memory_budget or draw fewer splats"
            )
        parts = min(max(2, -(-needed * 11 // (10 * self.picture.plan.capacity))), end - top)
        cuts = np.linspace(top, end, parts + 1).round().astype(int).tolist()
        return list(pairwise(cuts))

    def _gather(self, top: int, end: int) -> tuple[int, int]:
        """Packs the splats of rows of tiles [top, end).

        Returns how many there are (an estimate if they are too many), and how many the picture shows.
        """
        picture, height = self.picture, self.shape.tile_height
        count, chunk, chunks = picture.resident.count, picture.plan.chunk, self.shape.chunks
        picture.put_view(top * height, end * height)
        self.make_room(_TALLIES)
        sizes = {
            "splats": picture.program.source.records["Splat"].itemsize,
            **{"keys": KEYS, "windows": WINDOWS},
        }
        packed = {
            name: picture.take(f"packed {name}", size * picture.plan.capacity) for name, size in sizes.items()
        }
        total = seen = 0
        for start in range(0, count, chunk):
            stop = min(start + chunk, count)
            self.project(start, stop)
            picture.take("held", 8 * chunks)
            picture.launch("project", "pack_count", chunks, 1, count=stop - start)
            counts = picture.read("held", np.uint32, (2, chunks)).astype(np.int64)
            seen += int(counts[1].sum())
            places = np.concatenate([[0], np.cumsum(counts[0])]) + total
            total = int(places[-1])
            if total > picture.plan.capacity:
                return -(-total * count // stop), seen
            if int(picture.read("tallies", np.uint32, (_TALLIES,))[_BIG]) > self.big:
                self._more_room_for_big()
                return self._gather(top, end)
            picture.put("places", places[:-1].astype(np.uint32))
            out = {f"{name}_out": buffer for name, buffer in packed.items()}
            picture.launch("project", "pack_move", chunks, 1, count=stop - start, **out)
        picture.held |= packed
        self._count = total
        return total, seen

    def _more_room_for_big(self) -> None:
        needed = int(self.picture.read("tallies", np.uint32, (_TALLIES,))[_BIG])
        self.make_room(_TALLIES, 2 * needed)


class TiledLists(Lists):
    """Kernels tiles.cl. The buffers are as large as the last pictures needed, and all stages are launched
    before the host knows whether that is enough; if it is not, the lists are empty and it is all done again.
    """

    _ITEMS = 256  # WALK_ITEMS and SORT_ITEMS

    def __init__(self, picture: Picture) -> None:
        super().__init__(picture)
        self._pairs = 0
        # work-groups that share out the splats of many tiles
        self._big_groups = 4 * picture.workspace.device.max_compute_units

    def stats(self) -> Callable[[], dict[str, int]]:
        """To be asked for after the last band, and called when splats, visible and pairs are wanted."""
        queue, tallies = self.picture.queue, self.picture.held["tallies"]
        splats, pairs = self.picture.resident.count, self._pairs

        def read() -> dict[str, int]:
            words = np.empty(_TALLIES, np.uint32)
            cl.enqueue_copy(queue, words, tallies)
            return {"splats": splats, "visible": int(words[_VISIBLE]), "pairs": pairs}

        return read

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects; yields ranges of tiles (first, end), each when its lists are on the device."""
        picture = self.picture
        picture.put_view(0, picture.rows)
        capacity = min(
            picture.pool.size("lists") // 4, picture.pool.size("pairs") // 8, picture.workspace.pair_budget
        )
        self._project()
        counted = self._starts(capacity)
        if capacity:
            self._list(0, picture.tiles, capacity, True)
            yield 0, picture.tiles
        big, self._pairs = self._read(counted)
        while big > self.big:
            self._project(big)
            counted, capacity = self._starts(0), 0
            big, self._pairs = self._read(counted)
        if self._pairs > capacity or not capacity:
            yield from self._again()

    def _again(self) -> Iterator[tuple[int, int]]:
        """The lists in buffers that fit, in bands if need be."""
        picture, budget = self.picture, self.picture.workspace.pair_budget
        self._starts(2**32 - 1)
        bands = [(0, picture.tiles, self._pairs)]
        if self._pairs > budget:
            tallies = picture.read("tallies", np.uint32, (_TALLIES + picture.tiles,))
            bands = list(cut(tallies[_TALLIES:], budget))
        room = max(max(listed for _, _, listed in bands), min(self._pairs * 5 // 4, budget))
        for first, end, _ in bands:
            self._list(first, end, room, first == 0)
            yield first, end

    def _project(self, needed: int = 0) -> None:
        """Projects and tallies."""
        self.make_room(_TALLIES + self.picture.tiles, needed)
        self.project(0, self.picture.resident.count)
        self.picture.launch("bin", "tally_big", self._big_groups * self._ITEMS, self._ITEMS)

    def _starts(self, capacity: int) -> cl.Event:
        """Where each tile's list starts; all lists are empty if there are more pairs than `capacity`."""
        picture, items = self.picture, self.picture.shape.scan_items
        picture.take("starts", 4 * (picture.tiles + 1))
        picture.take("cursors", 4 * picture.tiles)
        # what the host reads has a buffer of its own: `emit` adds to the tallies meanwhile
        picture.take("counts", 4 * _COUNTS)
        return picture.launch("bin", "tile_starts", items, items, tiles=picture.tiles, capacity=capacity)

    def _list(self, first: int, end: int, capacity: int, first_band: bool) -> None:
        """The sorted lists of the tiles of one band."""
        picture, items, count = self.picture, self._ITEMS, self.picture.resident.count
        picture.take("pairs", 8 * capacity)
        picture.take("lists", 4 * capacity)
        groups = -(-count // items)
        walk = {"count": count, "splat_groups": groups, "first_band": first_band}
        band = {"band_first": first, "band_end": end, "capacity": capacity}
        picture.launch("bin", "emit", (groups + self._big_groups) * items, items, **walk, **band)
        picture.launch("sort", "sort_tiles", (end - first) * items, items, band_first=first)

    def _read(self, counted: cl.Event) -> tuple[int, int]:
        """Numbers of big splats and of pairs as `counted` has left them, while later stages picture."""
        words = np.empty(_COUNTS, np.uint32)
        self.picture.queue.flush()
        side = self.picture.workspace.side_queue
        cl.enqueue_copy(side, words, self.picture.held["counts"], wait_for=[counted])
        return int(words[0]), int(words[1]) | int(words[2]) << 32


LISTS = {"ordered": OrderedLists, "chunked": ChunkedLists, "tiled": TiledLists}
