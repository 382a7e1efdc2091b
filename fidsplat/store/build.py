"""Out-of-core build of a store (chunks on disk): bucket sort by Morton code, then levels of detail bottom up.

Inputs are read once, in windows of rows, and distributed over bucket files; each bucket is then sorted and
written. Progress is saved, so that an interrupted build resumes. `BuildSettings.memory` limits the memory.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import numpy as np

from fidsplat.store.build_plan import ON_PLANE, BuildPlan, BuildSettings, plan_build
from fidsplat.store.columns import ColumnFiles, enclose, node_record
from fidsplat.store.layout import NODE, Header, npy_header, write_nodes
from fidsplat.store.merge import REDUCTION, merged
from fidsplat.store.sources import Source, open_sources, splats_of
from fidsplat.store.staging import check_replaceable, clear, staged, store_folder
from fidsplat.store.streamed import import_streamed, is_streamed
from fidsplat.util import interrupts
from fidsplat.util.arguments import callback, settings_with
from fidsplat.util.errors import InputError, bytes_words
from fidsplat.util.files import from_json, path_of, read_input, write_json
from fidsplat.util.progress import Progress, no_progress

_SAVE_EVERY = 16
"""number of windows or merged nodes after which progress is saved"""
_MIN_ROOT = 64
"""number of splats below which no further level of detail is built"""


def build_store(
    inputs: Sequence[str | os.PathLike[str] | Source],
    out: str | os.PathLike[str],
    settings: BuildSettings | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    **changes: Any,
) -> Path:
    """Build a store from splat files and return its folder. The same call resumes an interrupted build.

    Args:
        inputs: PLY files of any size, which are read in windows; files of other formats, which are loaded; or
            `Source` objects. A streamed SOG (lod-meta.json) as the only input keeps its chunks and levels of
            detail; settings do not apply to it.
        out: the store's folder; its name ends with .fss.
        settings: `BuildSettings`; None: the defaults. `changes` are settings by name: chunk, memory, levels,
            sh_degree, colors.
        overwrite: whether to replace an existing store when the new one is complete.
        progress: called with the current step and its fraction done, 0 to 1.

    Raises:
        InputError: an invalid input, an existing store or one that another process builds, too little disk
            space.
    """
    progress = callback("progress", progress)
    folder = store_folder(out)
    check_replaceable(folder, overwrite)
    settings = settings_with(BuildSettings, settings, changes)
    progress = progress or no_progress
    if is_streamed(inputs):
        source = inputs if isinstance(inputs, (str, os.PathLike)) else inputs[0]
        import_streamed(path_of(cast("str", source)), folder, progress)
        return folder
    plan = plan_build(open_sources(inputs), settings)
    with staged(folder) as part:
        _Build(plan, part, progress).run()
    return folder


class _Build:
    """State of one build in its staging folder."""

    def __init__(self, plan: BuildPlan, folder: Path, progress: Progress) -> None:
        self.plan, self.folder, self.progress = plan, folder, progress
        self.buckets = len(plan.splitters) + 2  # the last bucket is for coplanar groups
        self.workers = min(4, os.cpu_count() or 1)
        self.state = self._saved_state()
        self.columns: ColumnFiles

    @property
    def pinned(self) -> int:
        """First row of the splats of coplanar groups."""
        return sum(self.state["lengths"][:-1])

    def run(self) -> None:
        """Run the remaining steps."""
        with ThreadPoolExecutor(self.workers) as pool:
            self._scatter(pool)
            kinds = dict(self.plan.columns)
            if not self.state["thick"]:  # files with three scales may contain only disks
                kinds.pop("thickness", None)
            with ColumnFiles(self.folder, kinds, self.plan.shapes) as self.columns:
                self._sort(pool)
                self._levels(pool)
                self._finish()

    def _saved_state(self) -> dict[str, Any]:
        """Saved progress; the initial state if none is saved for these inputs."""
        try:
            state = from_json(read_input(self.folder / "state.json"))
            if state["plan"] == self.plan.digest and self._is_on_disk(state):
                return state
        except (OSError, ValueError, KeyError, TypeError):
            pass
        clear(self.folder)
        free, needed = shutil.disk_usage(self.folder).free, self.plan.disk_bytes
        if needed > free:
            raise InputError(
                f"a build in {self.folder} needs up to {bytes_words(needed)} of disk space, got "
                f"{bytes_words(free)}; free some space, or build elsewhere"
            )
        fresh = {"plan": self.plan.digest, "lengths": [0] * self.buckets, "dropped": {}}
        return fresh | dict.fromkeys(("windows", "thick", "sorted", "nodes", "level", "merged"), 0)

    def _is_on_disk(self, state: dict[str, Any]) -> bool:
        """Whether all files of a saved state are complete. Raises OSError for a missing file."""
        left = list(enumerate(state["lengths"]))[state["sorted"] :]
        needed = [(self._bucket(number), count * self.plan.record.itemsize) for number, count in left]
        needed += [(self.folder / "nodes", state["nodes"] * NODE.itemsize)] if state["nodes"] else []
        return all(file.stat().st_size >= size for file, size in needed)

    def _save(self, **done: Any) -> None:
        self.state |= done
        write_json(self.folder / "state.json", self.state)

    def _in_order(
        self,
        pool: ThreadPoolExecutor,
        work: Callable[[Any], Any],
        inputs: Iterable[Any],
        max_pending: int | None = None,
    ) -> Iterator[Any]:
        """Run `work` in threads, and yield results in the order of inputs. max_pending: maximum number of
        pending results."""
        pending = self.workers if max_pending is None else max_pending - 1
        return interrupts.ordered_results((pool.submit(work, path) for path in inputs), pending)

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
                stream.truncate(lengths[number] * plan.record.itemsize)
                files.append(stream)
            first = state["windows"]
            for done, (by_bucket, why) in enumerate(
                self._in_order(pool, self._distributed, plan.windows[first:]), first + 1
            ):
                for number, records in by_bucket:
                    files[number].write(records.data)
                    lengths[number] += len(records)
                    if "thickness" in plan.columns:
                        thick += int(np.count_nonzero(records["thickness"]))
                dropped.update(why)
                if done % _SAVE_EVERY == 0 or done == len(plan.windows):
                    for stream in files:
                        stream.flush()
                    self._save(windows=done, lengths=lengths, dropped=dict(dropped), thick=thick)
                self.progress("reading splats", done / len(plan.windows))

    def _distributed(
        self, window: tuple[int, tuple[int, int]]
    ) -> tuple[list[tuple[int, np.ndarray]], dict[str, int]]:
        """Records of a window by bucket, in the order of the input; and invalid splats by reason."""
        plan, (number, span) = self.plan, window
        arrays, dropped = splats_of(plan.sources[number], span, plan.origin, plan.columns, plan.sh_degree)
        codes = plan.grid.codes(arrays["means"])
        if "coplanar_groups" in arrays:
            codes[arrays["coplanar_groups"] >= 0] = ON_PLANE
        buckets = np.searchsorted(plan.splitters, codes, side="right").astype(np.uint16)
        buckets[codes == ON_PLANE] = self.buckets - 1
        order = np.argsort(buckets, kind="stable")
        records = np.empty(len(order), plan.record)
        records["code"] = codes[order]
        for name, array in arrays.items():
            records[name] = array[order]
        ends = np.cumsum(np.bincount(buckets, minlength=self.buckets))
        buckets = np.split(records, ends[:-1])
        return [(number, rows) for number, rows in enumerate(buckets) if len(rows)], dropped

    # buckets to chunks

    def _sort(self, pool: ThreadPoolExecutor) -> None:
        lengths, done = self.state["lengths"], self.state["sorted"]
        firsts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        work = [(number, int(firsts[number])) for number in range(done, self.buckets)]
        for number, nodes in enumerate(self._in_order(pool, self._sorted, work), done):
            self._add_nodes(nodes)
            self._save(sorted=number + 1)
            self._bucket(number).unlink(missing_ok=True)
            self.progress("sorting", (number + 1) / self.buckets)

    def _sorted(self, work: tuple[int, int]) -> np.ndarray:
        """Sort and write a bucket's splats, and return the records of its chunks."""
        (number, first), plan = work, self.plan
        count = self.state["lengths"][number]
        if not count:
            return np.zeros(0, NODE)
        rows = np.memmap(self._bucket(number), plan.record, "r", 0, (count,)).view(np.ndarray)
        order = np.argsort(rows["code"].copy(), kind="stable")
        records = []
        for part in np.array_split(order, -(-count // plan.settings.chunk)):
            chunk = rows[part]
            splats = {name: np.ascontiguousarray(chunk[name]) for name in self.columns.kinds}
            records.append(node_record(splats, first))
            self.columns.write(first, splats)
            first += len(part)
        return np.concatenate(records)

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
        """Build levels of detail, four nodes to one, up to a single node of few splats."""
        while self.plan.settings.levels:
            nodes, level, done = self._nodes(), self.state["level"], self.state["merged"]
            groups = _groups(nodes, level, self.pinned)
            if not groups or (len(groups[0]) == 1 and _is_root(nodes, level)):
                return
            rows = int(nodes["first"][-1] + nodes["count"][-1])
            pending = min(self.workers, max(1, self.plan.settings.memory // self.plan.merge_bytes))
            work = self._in_order(pool, self._merged, (nodes[group] for group in groups[done:]), pending)
            for number, (parent, size) in enumerate(work, done + 1):
                node = node_record(parent, rows)
                node["level"], node["size"] = level + 1, size
                enclose(node, nodes[groups[number - 1]])
                self.columns.write(rows, parent)
                rows += len(parent["means"])
                self._add_nodes(node)
                if number % _SAVE_EVERY == 0:
                    self._save(merged=number)
                self.progress(f"level of detail {level + 1}", number / len(groups))
            self._save(level=level + 1, merged=0)

    def _merged(self, children: np.ndarray) -> tuple[dict[str, np.ndarray], float]:
        """Merged splats of nodes, given as records, and the edge [m] of the merged cells."""
        first, end = int(children["first"][0]), int(children["first"][-1] + children["count"][-1])
        return merged(self.columns.read(first, end), self.plan.grid)

    # completion

    def _finish(self) -> None:
        """Write headers and the index, and remove temporary files."""
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
            chunk=plan.settings.chunk,
            origin=tuple(plan.origin.tolist()),
            sh_degree=plan.sh_degree,
            columns=kinds,
            ellipsoids="none" if not thick else "all" if thick == splats else "some",
            nodes_crc=crc,
            identity=sha256(content).hexdigest(),
            dropped=dict(self.state["dropped"]),
            sources=tuple(source.rows.path.name for source in plan.sources),
        ).save(self.folder)
        # the state is removed first, as it must not describe removed files
        (self.folder / "state.json").unlink()
        for file in (self.folder / "nodes", *map(self._bucket, range(self.buckets))):
            file.unlink(missing_ok=True)


def _groups(nodes: np.ndarray, level: int, pinned: int) -> list[np.ndarray]:
    """Groups of node indices of a level; each group is merged to a node of the next level. Chunks of coplanar
    groups, whose rows begin at `pinned`, are not merged."""
    below = np.flatnonzero((nodes["level"] == level) & ((level > 0) | (nodes["first"] < pinned)))
    return np.array_split(below, -(-len(below) // REDUCTION)) if len(below) else []


def _is_root(nodes: np.ndarray, level: int) -> bool:
    """Whether no level above is worthwhile: the level has few splats, or more than half of the splats
    below."""
    counts = [int(nodes["count"][nodes["level"] == at].sum()) for at in (level - 1, level)]
    return counts[1] <= _MIN_ROOT or (level > 0 and 2 * counts[1] > counts[0])
