"""Building a store out of core: inputs are read once, in parts, and spread over buckets by their place in the
spatial order; each bucket is sorted and written; then levels of detail are made from the bottom up.

What is done is noted beside what is written, so that a build that was stopped goes on where it was. Memory
follows `Plan.memory`, not the inputs.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.formats.collect import Progress
from fidsplat.store.build_plan import ON_PLANE, Plan, plan_of
from fidsplat.store.columns import Columns, nodes_of
from fidsplat.store.folders import emptied, filled, refuse_existing, store_folder
from fidsplat.store.layout import CHUNK, NODE, Header, npy_header, write_nodes
from fidsplat.store.merge import REDUCTION, merged
from fidsplat.store.sources import Source, open_sources, splats_of
from fidsplat.util import interrupts
from fidsplat.util.arguments import callback
from fidsplat.util.errors import InputError, bytes_words
from fidsplat.util.files import atomic_write, from_json, read_input

_NOTED = 16
"""parts of the work after which it is noted what is done"""
_ROOT = 64
"""splats at which nothing is gained by fewer"""


def build_store(
    inputs: Sequence[str | os.PathLike[str] | Source],
    out: str | os.PathLike[str],
    *,
    chunk: int = CHUNK,
    memory: int = 2 * 2**30,
    levels: bool = True,
    sh_degree: int | None = None,
    colors: str = "float32",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Build a store of files of splats, and return its folder. The same call goes on with one that was
    stopped.

    Args:
        inputs: PLY files of any size, which are read in parts; files of other formats, which are loaded; or
            `Source`s, rows that somebody makes.
        out: the store's folder; its name ends with .fss.
        chunk: splats of a chunk. memory: bytes to take at most, roughly.
        levels: whether levels of detail are made.
        sh_degree: the highest degree of SH to keep; None: that of the inputs.
        colors: what colours and SH are stored as, float32 or float16.
        overwrite: whether a store that is there is replaced, once the new one is whole.
        progress: called now and then with what is being done and the share of it that is done, 0 to 1.

    Raises:
        InputError: an input that cannot be used, a store that is there or that another process builds, a disk
            without room.
    """
    progress = callback("progress", progress)
    folder = store_folder(out)
    refuse_existing(folder, overwrite)
    plan = plan_of(open_sources(inputs), chunk, memory, levels, sh_degree, colors)
    with filled(folder) as part:
        _Build(plan, part, progress or (lambda words, share: None)).run()
    return folder


class _Build:
    """One build, in a folder of its own."""

    def __init__(self, plan: Plan, folder: Path, progress: Progress) -> None:
        self.plan, self.folder, self.progress = plan, folder, progress
        self.buckets = len(plan.splitters) + 2  # the last for splats on planes
        self.workers = min(4, os.cpu_count() or 1)
        self.state = self._begun()
        self.columns: Columns

    @property
    def pinned(self) -> int:
        """The first row of splats on planes."""
        return sum(self.state["lengths"][:-1])

    def run(self) -> None:
        """All that is left to do."""
        with ThreadPoolExecutor(self.workers) as pool:
            self._scatter(pool)
            kinds = dict(self.plan.columns)
            if not self.state["thick"]:  # files with three scales may hold disks alone
                kinds.pop("thickness", None)
            with Columns(self.folder, kinds, self.plan.shapes) as self.columns:
                self._sort(pool)
                self._levels(pool)
                self._finish()

    def _begun(self) -> dict[str, Any]:
        """What is done; nothing, if it was begun from other inputs or not at all."""
        try:
            state = from_json(read_input(self.folder / "state.json"))
            if state["plan"] == self.plan.digest and self._there(state):
                return state
        except (OSError, ValueError, KeyError, TypeError):
            pass
        emptied(self.folder)
        free, needed = shutil.disk_usage(self.folder).free, self.plan.disk_bytes
        if needed > free:
            raise InputError(
                f"building takes up to {bytes_words(needed)} beside {self.folder}, and {bytes_words(free)} "
                "are free; make room, or build elsewhere"
            )
        fresh = {"plan": self.plan.digest, "lengths": [0] * self.buckets, "dropped": {}}
        return fresh | dict.fromkeys(("windows", "thick", "sorted", "nodes", "level", "merged"), 0)

    def _there(self, state: dict[str, Any]) -> bool:
        """Whether what is noted is on disk: after a power cut it need not be. Raises OSError for a file that
        is missing."""
        left = list(enumerate(state["lengths"]))[state["sorted"] :]
        needed = [(self._bucket(number), count * self.plan.record.itemsize) for number, count in left]
        needed += [(self.folder / "nodes", state["nodes"] * NODE.itemsize)] if state["nodes"] else []
        return all(file.stat().st_size >= size for file, size in needed)

    def _note(self, **done: Any) -> None:
        self.state |= done
        with atomic_write(self.folder / "state.json") as stream:
            stream.write(json.dumps(self.state).encode())

    def _in_turn(
        self,
        pool: ThreadPoolExecutor,
        work: Callable[[Any], Any],
        given: Iterable[Any],
        most: int | None = None,
    ) -> Iterator[Any]:
        """Results in the order of what is given, worked out by threads a little ahead. most: how many at
        once; None: one for each thread, and results that wait."""
        waiting: deque[Future] = deque()
        for one in given:
            waiting.append(pool.submit(work, one))
            if len(waiting) > (self.workers if most is None else most - 1):
                yield interrupts.result_of(waiting.popleft())
        while waiting:
            yield interrupts.result_of(waiting.popleft())

    # inputs to buckets

    def _bucket(self, number: int) -> Path:
        return self.folder / f"bucket-{number:04d}"

    def _scatter(self, pool: ThreadPoolExecutor) -> None:
        plan, state = self.plan, self.state
        if state["windows"] == len(plan.windows):
            return
        lengths, dropped, thick = list(state["lengths"]), Counter(state["dropped"]), state["thick"]
        with ExitStack() as stack:
            files = []
            for number in range(self.buckets):
                stream = stack.enter_context(self._bucket(number).open("ab"))
                stream.truncate(lengths[number] * plan.record.itemsize)  # of a part that was not noted
                files.append(stream)
            first = state["windows"]
            for done, (parts, why) in enumerate(
                self._in_turn(pool, self._spread, plan.windows[first:]), first + 1
            ):
                for number, records in parts:
                    files[number].write(records.data)
                    lengths[number] += len(records)
                    if "thickness" in plan.columns:
                        thick += int(np.count_nonzero(records["thickness"]))
                dropped.update(why)
                if done % _NOTED == 0 or done == len(plan.windows):
                    for stream in files:
                        stream.flush()
                    self._note(windows=done, lengths=lengths, dropped=dict(dropped), thick=thick)
                self.progress("reading splats", done / len(plan.windows))

    def _spread(
        self, window: tuple[int, tuple[int, int]]
    ) -> tuple[list[tuple[int, np.ndarray]], dict[str, int]]:
        """The splats of a part of an input by their buckets, each in the order of the input."""
        plan, (number, span) = self.plan, window
        arrays, dropped = splats_of(plan.sources[number], span, plan.origin, plan.columns, plan.sh_degree)
        codes = plan.grid.codes(arrays["means"])
        if "planes" in arrays:
            codes[arrays["planes"] >= 0] = ON_PLANE
        buckets = np.searchsorted(plan.splitters, codes, side="right").astype(np.uint16)
        buckets[codes == ON_PLANE] = self.buckets - 1
        order = np.argsort(buckets, kind="stable")
        records = np.empty(len(order), plan.record)
        records["code"] = codes[order]
        for name, array in arrays.items():
            records[name] = array[order]
        ends = np.cumsum(np.bincount(buckets, minlength=self.buckets))
        parts = np.split(records, ends[:-1])
        return [(at, own) for at, own in enumerate(parts) if len(own)], dropped

    # buckets to chunks

    def _sort(self, pool: ThreadPoolExecutor) -> None:
        lengths, done = self.state["lengths"], self.state["sorted"]
        firsts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        work = [(number, int(firsts[number])) for number in range(done, self.buckets)]
        for number, nodes in enumerate(self._in_turn(pool, self._sorted, work), done):
            self._add_nodes(nodes)
            self._note(sorted=number + 1)
            self._bucket(number).unlink(missing_ok=True)
            self.progress("sorting", (number + 1) / self.buckets)

    def _sorted(self, work: tuple[int, int]) -> np.ndarray:
        """Writes a bucket's splats in their order, and returns the records of its chunks."""
        (number, first), plan = work, self.plan
        count = self.state["lengths"][number]
        if not count:
            return np.zeros(0, NODE)
        rows = np.memmap(self._bucket(number), plan.record, "r", 0, (count,)).view(np.ndarray)
        order = np.argsort(rows["code"].copy(), kind="stable")
        made = []
        for part in np.array_split(order, -(-count // plan.chunk)):
            taken = rows[part]
            splats = {name: np.ascontiguousarray(taken[name]) for name in self.columns.kinds}
            made.append(nodes_of(splats, first))
            self.columns.write(first, splats)
            first += len(part)
        return np.concatenate(made)

    # chunks to levels of detail

    def _nodes(self) -> np.ndarray:
        if not self.state["nodes"]:
            return np.zeros(0, NODE)
        return np.fromfile(self.folder / "nodes", NODE, self.state["nodes"])

    def _add_nodes(self, nodes: np.ndarray) -> None:
        with (self.folder / "nodes").open("ab") as stream:
            stream.truncate(self.state["nodes"] * NODE.itemsize)
            stream.write(nodes.tobytes())
        self.state["nodes"] += len(nodes)

    def _levels(self, pool: ThreadPoolExecutor) -> None:
        """Nodes above nodes, four to one, until one of a few splats stands for all."""
        while self.plan.levels:
            nodes, level, done = self._nodes(), self.state["level"], self.state["merged"]
            groups = _groups(nodes, level, self.pinned)
            if not groups or (len(groups[0]) == 1 and _settled(nodes, level)):
                return
            rows = int(nodes["first"][-1] + nodes["count"][-1])
            most = min(self.workers, max(1, self.plan.memory // self.plan.merge_bytes))
            work = self._in_turn(pool, self._merged, (nodes[group] for group in groups[done:]), most)
            for number, (made, size) in enumerate(work, done + 1):
                node = nodes_of(made, rows)
                node["level"], node["size"] = level + 1, size
                _enclose(node, nodes[groups[number - 1]])
                self.columns.write(rows, made)
                rows += len(made["means"])
                self._add_nodes(node)
                if number % _NOTED == 0:
                    self._note(merged=number)
                self.progress(f"level of detail {level + 1}", number / len(groups))
            self._note(level=level + 1, merged=0)

    def _merged(self, children: np.ndarray) -> tuple[dict[str, np.ndarray], float]:
        """Splats that stand for those of the nodes (records), and the edge [m] of their cells."""
        first, end = int(children["first"][0]), int(children["first"][-1] + children["count"][-1])
        return merged(self.columns.read(first, end), self.plan.grid)

    # all together

    def _finish(self) -> None:
        """Headers, the index, and no trace of the work."""
        plan, kinds, nodes = self.plan, self.columns.kinds, self._nodes()
        for level in range(int(nodes["level"].max(initial=0))):
            above = np.flatnonzero(nodes["level"] == level + 1)
            for parent, group in zip(above, _groups(nodes, level, self.pinned), strict=True):
                nodes["parent"][group] = parent
        splats, rows, thick = sum(self.state["lengths"]), int(nodes["count"].sum()), self.state["thick"]
        for name, kind in kinds.items():
            self.columns.finish(name, npy_header(kind, (rows, *plan.shapes[name])), rows)
        crc = write_nodes(self.folder, nodes)
        content = nodes.tobytes() + repr((kinds, plan.sh_degree, plan.origin.tolist())).encode()
        Header(
            splats=splats,
            rows=rows,
            pinned=self.pinned,
            chunk=plan.chunk,
            origin=tuple(plan.origin.tolist()),
            sh_degree=plan.sh_degree,
            columns=kinds,
            ellipsoids="none" if not thick else "all" if thick == splats else "some",
            nodes_crc=crc,
            identity=sha256(content).hexdigest(),
            dropped=dict(self.state["dropped"]),
            sources=tuple(source.rows.path.name for source in plan.sources),
        ).save(self.folder)
        # the note first: what it says is done must be there
        (self.folder / "state.json").unlink()
        for file in (self.folder / "nodes", *map(self._bucket, range(self.buckets))):
            file.unlink(missing_ok=True)


def _groups(nodes: np.ndarray, level: int, pinned: int) -> list[np.ndarray]:
    """Which nodes (numbers) of a level one node of the next stands for, in their order. Chunks from row
    `pinned` on have none."""
    below = np.flatnonzero((nodes["level"] == level) & ((level > 0) | (nodes["first"] < pinned)))
    return np.array_split(below, -(-len(below) // REDUCTION)) if len(below) else []


def _enclose(node: np.ndarray, children: np.ndarray) -> None:
    """Makes a node reach as far as those that it stands for: where it is not looked for, they are not, and it
    is as near and as coarse as any of them."""
    node["size"] = max(float(node["size"][0]), float(children["size"].max()))
    for name in ("low", "far_low"):
        node[name] = np.minimum(node[name], children[name].min(axis=0))
    for name in ("high", "far_high"):
        node[name] = np.maximum(node[name], children[name].max(axis=0))
    node["reach"] = max(float(node["reach"][0]), float(children["reach"].max()))


def _settled(nodes: np.ndarray, level: int) -> bool:
    """Whether little is gained by a node above the only one of this level: not half of its splats."""
    counts = [int(nodes["count"][nodes["level"] == at].sum()) for at in (level - 1, level)]
    return counts[1] <= _ROOT or (level > 0 and 2 * counts[1] > counts[0])
