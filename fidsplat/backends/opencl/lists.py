"""The lists of splats per tile, in depth order, made in one of two ways, of which one has a variant.

On CPUs (`ordered`) all visible splats are sorted by depth, then listed per tile in that order, by counting
sorts over a few contiguous pieces: long sequential walks and no atomics. On GPUs (`tiled`) every splat counts
its tiles while it is projected, pairs are written to the tiles in any order, and each tile's list is sorted
in local memory: few launches, all of them wide. Of many small views and of stores (`gathered`) tiles are
counted for thousands of splats at a time, in local memory: where neighbours in memory touch the same tile,
atomics of its one word wait for each other. devlog/growth.md has both ways on both kinds of device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.bands import cut
from fidsplat.backends.opencl.counts import COUNTS, counts_after, fullness_of, read_counts, stats_of
from fidsplat.backends.opencl.memory_plan import BIG, KEYS, WINDOWS
from fidsplat.backends.opencl.picture import Picture
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.util.errors import DeviceError

# words of the buffer `tallies`, as in prelude.cl
_VISIBLE, _PAIRS, _BIG, _TALLIES = 0, 2, 6, 8
_NO_WINDOW = np.array([0xFFFFFFFF, 0], np.uint32)


class Lists:
    """What all ways share: the projection and its room for big splats."""

    def __init__(self, picture: Picture) -> None:
        self.picture, self.shape = picture, picture.shape
        self.big = 0
        """big splats for which there is room"""
        self.end = picture.tiles
        """the last range of tiles ends there"""

    def make_room(self, words: int, needed: int = 0) -> None:
        """Takes `words` words of zeroed tallies, and room for at least `needed` big splats."""
        picture = self.picture
        self.big = max(needed * 5 // 4, picture.pool.size("big") // 4, BIG)
        picture.held["big_capacity"] = self.big
        picture.take("big", 4 * self.big)
        picture.take("big_bounds", picture.source.records["Bounds"].itemsize * self.big)
        if picture.repeats:
            picture.held["tallies"] = picture.pool.zeroed("tallies", 4 * words, picture.queue)
            return
        tallies = picture.take("tallies", 4 * words)
        cl.enqueue_fill_buffer(picture.queue, tallies, np.zeros(1, np.uint32), 0, 4 * words)

    def room(self, count: int) -> int:
        """Places of so many splats of each view."""
        resident = self.picture.resident
        return self.picture.views * (resident.room if count == resident.count else count)

    def project(self, first: int, end: int) -> None:
        """Records, keys and windows of splats [first, end)."""
        picture, count = self.picture, end - first
        source, places = picture.source, self.room(count)
        picture.take("splats", places * source.records["Splat"].itemsize)
        picture.take("keys", KEYS * places)
        windows = picture.take("windows", WINDOWS * places)
        if picture.view.band is not None and places:
            # splats beside the band get no window of their own: one without tiles, of no big splat
            cl.enqueue_fill_buffer(picture.queue, windows, _NO_WINDOW, 0, WINDOWS * places)
        if count == 0:
            return
        wanted = [one.name for one in source.arguments["project"] if one.source == "cloud"]
        arrays = {name: picture.resident.part(name, first, end) for name in wanted}
        picture.launch("project", "project", count, 64, picture.views, count=count, **arrays)


class OrderedLists(Lists):
    """Kernels scan.cl, sort.cl, bin.cl."""

    def __init__(self, picture: Picture) -> None:
        super().__init__(picture)
        self._stats: dict[str, int] = {}
        self.first = 0
        """tiles before it are in rows that nobody wants"""
        if picture.view.band is not None and picture.views == 1:
            first, end = picture.view.band
            self.first = first // self.shape.tile_height * picture.tiles_x
            self.end = -(-end // self.shape.tile_height) * picture.tiles_x
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
            self.make_room(_TALLIES * picture.views, int(words[_BIG]))
            self.project(0, self._count)
            self._sort()
            words, visible = self._tally()
            if words[_BIG] <= self.big:
                break
        pairs = int(words[_PAIRS]) | int(words[_PAIRS + 1]) << 32
        self._stats = {"splats": picture.resident.count, "visible": visible, "pairs": pairs}
        picture.pairs = pairs
        yield from self._list(self.first, self.end, pairs)

    def _list(self, first: int, end: int, pairs: int) -> Iterator[tuple[int, int]]:
        """Lists the tiles [first, end), in as many bands as the budget of pairs asks for."""
        picture = self.picture
        bands = [(first, end, pairs)]
        if pairs > picture.workspace.pair_budget:
            totals = picture.read("bin totals", np.uint32, (picture.tiles,))[first:end]
            bands = cut(totals, picture.workspace.pair_budget, first)
        for start, stop, listed in bands:
            known, most = picture.pool.size("lists") // 4, picture.workspace.pair_budget
            # where the last view needed less, the next may need more
            room = max(listed, min(listed * 9 // 8, most)) if 0 < known < listed else listed
            picture.take("lists", 4 * room)
            band = {"band_first": start, "band_end": stop, "count": self._count}
            table, views = picture.held["bin table"], picture.views
            picture.launch("bin", "bin_emit", self.shape.chunks, 1, views, table=table, **band)
            yield start, stop

    def _sort(self) -> None:
        """Visible splats by depth, ties by index."""
        picture, views = self.picture, self.picture.views
        count, bins = self._count, 1 << self.shape.radix_bits
        table = picture.take("sort table", 4 * bins * self.shape.chunks * views)
        size = 4 * self.room(count)
        keys, order = picture.held["keys"], picture.take("order 0", size)
        for number, shift in enumerate(range(0, 32, self.shape.radix_bits)):
            keys_out = picture.take(f"sorted keys {number % 2}", size)
            order_out = picture.take(f"order {(number + 1) % 2}", size)
            digit = {"keys": keys, "count": count, "first": number == 0, "shift": shift, "table": table}
            picture.launch("sort", "sort_count", self.shape.chunks, 1, views, **digit)
            digit |= {"starts": self._starts("sort", table, bins, _VISIBLE, views), "indices": order}
            out = {"keys_out": keys_out, "indices_out": order_out}
            picture.launch("sort", "sort_scatter", self.shape.chunks, 1, views, **digit, **out)
            keys, order = keys_out, order_out
        picture.held["order"] = order

    def _tally(self) -> tuple[np.ndarray, int]:
        """Lengths of the tiles' lists; returns the first view's tallies, and how many splats all see."""
        picture, views = self.picture, self.picture.views
        table = picture.take("bin table", 4 * picture.tiles * self.shape.chunks)
        picture.launch("bin", "bin_count", self.shape.chunks, 1, views, table=table, count=self._count)
        # one list: those of the second view follow those of the first
        picture.held["starts"] = self._starts("bin", table, picture.tiles // views, _PAIRS, 1)
        words = picture.read("tallies", np.uint32, (views, _TALLIES))
        return words[0], int(words[:, _VISIBLE].sum(dtype=np.int64))

    def _starts(self, stage: str, table: cl.Buffer, bins: int, slot: int, lists: int) -> cl.Buffer:
        """Turns the views' tables of counts into places in `lists` lists, one for each view or one for all:
        returns where each bin starts (lists, all bins of the list + 1)."""
        picture, views = self.picture, self.picture.views
        totals = picture.take(f"{stage} totals", 4 * bins * views)
        each = bins * views // lists
        starts = picture.take(f"{stage} starts", 4 * (each + 1) * lists)
        items = self.shape.scan_items
        picture.launch(stage, "scan_chunks", bins, 64, views, table=table, bins=bins, totals=totals)
        scan = {"bins": each, "totals": totals, "starts": starts, "slot": slot}
        picture.launch(stage, "scan_bins", items, items, lists, **scan)
        return starts


class ChunkedLists(OrderedLists):
    """Kernels pack.cl beside those of OrderedLists: the cloud is projected a chunk at a time, and only what
    is seen is kept. If that is still too much, the picture is drawn in bands of rows of tiles, the whole
    cloud being projected for each. A tile's list is the same as ever, and so is the picture.
    """

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects and sorts; yields ranges of tiles (first, end), each when its lists are on the device."""
        picture = self.picture
        rows = [(self.first // picture.tiles_x, self.end // picture.tiles_x)]
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
            "splats": picture.source.records["Splat"].itemsize,
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
            out: dict[str, Any] = {f"{name}_out": buffer for name, buffer in packed.items()}
            picture.launch("project", "pack_move", chunks, 1, count=stop - start, **out)
        picture.held |= packed
        self._count = total
        return total, seen

    def _more_room_for_big(self) -> None:
        needed = int(self.picture.read("tallies", np.uint32, (_TALLIES,))[_BIG])
        self.make_room(_TALLIES, 2 * needed)


class TiledLists(Lists):
    """Kernels tile_lists.cl. The buffers are as large as the last pictures needed, and all stages are
    launched before the host knows whether that is enough; if it is not, the lists are empty and it is all
    done again: at once, or, where one of its kind was drawn before, when it is
    read (`Repeat.settled`).
    """

    _ITEMS = 256  # BIN_ITEMS and SORT_ITEMS

    def __init__(self, picture: Picture) -> None:
        super().__init__(picture)
        self._pairs = 0
        # work-groups that share out the splats of many tiles
        self._big_groups = 4 * picture.workspace.device.max_compute_units

    def stats(self) -> Callable[[], dict[str, int]]:
        """To be asked for after the last band, and called when splats, visible and pairs are wanted."""
        picture, splats = self.picture, self.picture.resident.count
        reader, counts, last = picture.workspace.read_queue, picture.held["counts"], picture.events[-1][1]
        picture.queue.flush()
        return lambda: stats_of(splats, read_counts(reader, counts, [last]))

    def bands(self) -> Iterator[tuple[int, int]]:
        """Projects; yields ranges of tiles (first, end), each when its lists are on the device."""
        picture = self.picture
        picture.put_view(0, picture.rows)
        # what the host reads has a buffer of its own: `emit` adds to it meanwhile
        picture.lease("counts", 4 * COUNTS)
        capacity = self.capacity(picture.workspace)
        if picture.trusted:
            capacity = min(capacity, picture.trusted)
        self._project()
        counted = self._starts(capacity)
        if capacity:
            self._list(0, picture.tiles, capacity, True)
            yield 0, picture.tiles
        if picture.repeats:
            return
        if capacity and picture.trusted:
            picture.counted, picture.pairs = counted, capacity
            return
        big, self._pairs = self._read(counted)
        while big > self.big:
            self._project(big)
            counted, capacity = self._starts(0), 0
            big, self._pairs = self._read(counted)
        picture.pairs = self._pairs
        if self._pairs > capacity or not capacity:
            yield from self._again()

    @staticmethod
    def capacity(workspace: Workspace) -> int:
        """Pairs for which the last pictures have left room."""
        pool = workspace.pool
        return min(pool.size("lists") // 4, pool.size("pairs") // 8, workspace.pair_budget)

    def _again(self) -> Iterator[tuple[int, int]]:
        """The lists in buffers that fit, in bands if need be."""
        picture, budget = self.picture, self.picture.workspace.pair_budget
        self._starts(2**32 - 1)
        bands = [(0, picture.tiles, self._pairs)]
        if self._pairs > budget:
            tallies = picture.read("tallies", np.uint32, (_TALLIES + picture.tiles,))
            bands = list(cut(tallies[_TALLIES:], budget))
            picture.in_bands = True
        room = max(max(listed for _, _, listed in bands), min(self._pairs * 5 // 4, budget))
        for first, end, _ in bands:
            self._list(first, end, room, first == 0)
            yield first, end

    def _project(self, needed: int = 0) -> None:
        """Projects and tallies."""
        self.make_room(_TALLIES + self.picture.tiles, needed)
        self.project(0, self.picture.resident.count)
        count = self.picture.resident.count
        self.picture.launch("bin", "tally_big", self._big_groups * self._ITEMS, self._ITEMS, count=count)

    def _starts(self, capacity: int) -> cl.Event:
        """Where each tile's list starts; all lists are empty if there are more pairs than `capacity`."""
        picture, items = self.picture, self.picture.shape.scan_items
        picture.take("starts", 4 * (picture.tiles + 1))
        picture.take("cursors", 4 * picture.tiles)
        given = {"tiles": picture.tiles, "capacity": capacity, "clear": picture.repeats}
        return picture.launch("bin", "tile_starts", items, items, **given)

    def _list(self, first: int, end: int, capacity: int, first_band: bool) -> None:
        """The sorted lists of the tiles of one band."""
        picture, items = self.picture, self._ITEMS
        picture.take("pairs", 8 * capacity)
        picture.take("lists", 4 * capacity)
        self._emit({"band_first": first, "band_end": end, "capacity": capacity, "first_band": first_band})
        picture.launch("sort", "sort_tiles", (end - first) * items, items, band_first=first)

    def _emit(self, band: dict[str, Any]) -> None:
        """The pairs of a band."""
        picture, items, count = self.picture, self._ITEMS, self.picture.resident.count
        groups, views = -(-count // items), picture.views
        all_groups = groups + -(-self._big_groups // views)
        walk = {"count": count, "splat_groups": groups}
        picture.launch("bin", "emit", all_groups * items, items, views, **walk, **band)

    def _read(self, counted: cl.Event) -> tuple[int, int]:
        """Numbers of big splats and of pairs as `counted` has left them, while later stages picture."""
        return fullness_of(counts_after(counted, self.picture))


class GatheredLists(TiledLists):
    """Kernels tile_lists_local.cl with those of TiledLists: work-groups take many splats of a view each, and
    count their pairs in local memory. For many views, of at most TILES tiles each, and for splats whose
    neighbours lie near each other.
    """

    TILES = 4096  # GATHER_TILES
    _GATHERED = 4096  # as there

    def _project(self, needed: int = 0) -> None:
        """Projects and tallies."""
        super()._project(needed)
        self._gather("tally_gathered")

    def _emit(self, band: dict[str, Any]) -> None:
        """The pairs of a band: of the splats of many tiles, then of all others."""
        picture, items, count = self.picture, self._ITEMS, self.picture.resident.count
        big = {"count": count, "splat_groups": 0}
        picture.launch("bin", "emit", self._big_groups * items, items, **big, **band)
        self._gather("emit_gathered", **band)

    def _gather(self, kernel: str, **given: Any) -> None:
        """Launch of a kernel of tile_lists_local.cl."""
        picture, count = self.picture, self.picture.resident.count
        if count == 0:
            return
        groups, items = -(-count // self._GATHERED), picture.shape.scan_items
        picture.launch("bin", kernel, groups * items, items, picture.views, count=count, **given)


LISTS = {"ordered": OrderedLists, "chunked": ChunkedLists, "tiled": TiledLists, "gathered": GatheredLists}
