"""Resumable sweeps over points (combinations of parameters), with shards that can be merged.

Results are JSON lines. A line {"run": ...} contains facts of a run (`fidsplat.util.provenance.run_facts`)
that apply to the following lines {"key": ..., "result": ...}.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from fidsplat.util.errors import FidsplatError, InputError, os_errors
from fidsplat.util.files import atomic_write, from_json, ordinary_file, read_text, writable_folder

Key = dict[str, Any]
"""parameters of a point of a sweep: names and plain values"""
Work = Callable[[], dict[str, Any]]
"""function that evaluates the images of a point; returns its result"""


class Record(NamedTuple):
    """Result of a measured point."""

    key: Key
    result: dict[str, Any]
    run: dict[str, Any]
    """facts of the run"""

    @property
    def name(self) -> str:
        return name_of(self.key)

    @property
    def failed(self) -> bool:
        """Whether the device failed for this point; the result has the reason as `error`."""
        return "error" in self.result


def name_of(key: Key) -> str:
    """Key as a string that does not depend on the order of its items."""
    return json.dumps(key, sort_keys=True)


class Results:
    """Results file of a sweep, written after each point.

    Args:
        file: created with its folder if missing.
        run: facts of this run.
        overwrite: delete existing results.

    Raises InputError if the file cannot be written, has another format, or has results of another device,
    version, code or seed.
    """

    def __init__(self, file: Path, run: dict[str, Any], overwrite: bool = False) -> None:
        writable_folder(file.parent)
        self.file, self.run = ordinary_file(file), run
        records = [] if overwrite else read_records(file)
        for record in records:
            if differ := differences(record.run, run):
                raise InputError(
                    f"results in {file} must be of the same {' and '.join(differ)}, got others; give another "
                    "folder with -o, or --overwrite to measure again"
                )
        # failed points are measured again, since the device may work now
        self.done = {record.name: record for record in records if not record.failed}
        if overwrite or file.exists():  # discards the incomplete last line of a killed run
            _write(file, self.done.values())
        self._last_run = next((record.run for record in reversed(self.done.values())), None)

    def left(self, points: Iterable[Key]) -> list[Key]:
        """Points without a result, in the order of `points`."""
        return [key for key in points if name_of(key) not in self.done]

    def append(self, key: Key, result: dict[str, Any]) -> Record:
        """Append a result, with numbers rounded to six digits.

        Raises ValueError for NaN and other values that JSON lacks, InputError if the file cannot grow.
        """
        record = Record(key, rounded(result), self.run)
        text = _line(record) if self.run == self._last_run else _header(self.run) + _line(record)
        remedy = "earlier results stay, and the same command resumes from them"
        with os_errors(f"cannot write {self.file}", remedy), open(self.file, "a", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        self._last_run = self.run
        self.done[record.name] = record
        return record


class TimeLimit:
    """Time limit of a run. A batch may start if the run stays within the limit even if the batch takes as
    long as the longest one so far."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self._longest = seconds, 0.0
        self._begun: float | None = None

    def allows(self) -> bool:
        """Whether another batch may start. The clock starts at the first call."""
        now = time.monotonic()
        self._begun = now if self._begun is None else self._begun
        return now - self._begun + self._longest < self.seconds

    @contextmanager
    def batch(self) -> Iterator[None]:
        begun = time.monotonic()
        yield
        self._longest = max(self._longest, time.monotonic() - begun)


@dataclass(frozen=True, eq=False)
class Sweep:
    """Parameter sweep: points, their measurement, and the results file."""

    name: str
    results: Results
    points: list[Key]
    begin: Callable[[Key], Work]
    """renders the images of a point on the device; returns the function that evaluates them"""
    batch: int = 1
    """number of points that are rendered before their evaluation, so that evaluation disturbs no timing"""
    pool: Executor | None = None
    """executor that evaluates the points of a batch in parallel"""
    overlap: bool = False
    """whether the next batch is rendered while a batch is evaluated; not for sweeps that measure time"""
    record_errors: bool = False
    """whether a FidsplatError of `begin` is stored as the result of the point, as `error`"""
    limit: TimeLimit | None = None
    """time limit of a run; the next run measures the remaining points"""
    estimate: Callable[[], float] | None = None
    """function that estimates the seconds of the missing points"""

    @property
    def records(self) -> list[Record]:
        """Records of the sweep's points, including those of earlier runs."""
        done = self.results.done
        return [done[name] for name in map(name_of, self.points) if name in done]

    @property
    def left(self) -> list[Key]:
        return self.results.left(self.points)

    def run(self) -> Iterator[Record]:
        """Measure the missing points; yields each record after it is written to the file.

        An interrupt loses at most one batch, with `overlap` two.
        """
        left, last = self.left, iter(())
        for first in range(0, len(left), self.batch):
            if self.limit is not None and not self.limit.allows():
                break
            keys = left[first : first + self.batch]
            with nullcontext() if self.limit is None else self.limit.batch():
                work = [self._begin(key) for key in keys]
                results = map(_call, work) if self.pool is None else self.pool.map(_call, work)
                begun = zip(keys, results, strict=True)
                yield from self._written(last if self.overlap else begun)
                last = begun
        yield from self._written(last)

    def _written(self, evaluated: Iterable[tuple[Key, dict[str, Any]]]) -> Iterator[Record]:
        for key, result in evaluated:
            yield self.results.append(key, result)

    def _begin(self, key: Key) -> Work:
        try:
            return self.begin(key)
        except FidsplatError as error:
            if not self.record_errors:
                raise
            result = {"error": str(error)}
            return lambda: result


@contextmanager
def thread_pool(workers: int) -> Iterator[ThreadPoolExecutor]:
    """Threads that evaluate points of sweeps; an interrupt cancels waiting tasks."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def read_records(file: Path) -> list[Record]:
    """Records of a file; empty if the file is missing. An incomplete last line is skipped.

    Raises InputError for a file of another format.
    """
    if not file.exists():
        return []
    try:
        text = read_text(file)
    except UnicodeDecodeError as error:
        raise InputError(f"cannot read {file}: {error}; remove it, and measure again") from error
    records: list[Record] = []
    run: dict[str, Any] | None = None
    for number, line in enumerate(text.split("\n")[:-1], 1):
        try:
            value = from_json(line, finite=True)
            if set(value) == {"run"}:
                run = value["run"]
                continue
            key, result = value["key"], value["result"]
            if not (isinstance(key, dict) and isinstance(result, dict) and isinstance(run, dict)):
                raise TypeError
        except (ValueError, KeyError, TypeError):
            raise InputError(
                f"{file}, line {number}: not a result of this version of fidsplat; give another folder"
            ) from None
        records.append(Record(key, result, run))
    return records


def folder_records(folder: Path, name: str) -> list[Record]:
    """Records of an experiment in a folder, including shards that are not merged."""
    files = [folder / f"{name}.jsonl", *sorted(folder.glob(f"{name}-*-of-*.jsonl"))]
    return [record for file in files for record in read_records(file)]


def shard(points: list[Key], text: str | None) -> list[Key]:
    """Every n-th point from the i-th on, for "i/n"; all points for None.

    Raises InputError unless 1 <= i <= n.
    """
    if text is None:
        return points
    first, _, of = text.partition("/")
    if not (first.isdecimal() and of.isdecimal() and 1 <= int(first) <= int(of)):
        raise InputError(f"--shard must be i/n with 1 <= i <= n, e.g. 1/4, got {text!r}")
    return points[int(first) - 1 :: int(of)]


class Merged(NamedTuple):
    """Result of `merge`."""

    points: int
    repeated: int
    """number of points in more than one file"""
    differ: tuple[str, ...]
    """facts that affect results and differ between the runs"""


def merge(files: Sequence[Path], target: Path) -> Merged:
    """Merge files of shards into one. The first record of a point is used; other points of the target remain.

    Raises InputError for a missing file or another format.
    """
    records: dict[str, Record] = {}
    repeated = 0
    for file in files:
        if not file.is_file():
            raise InputError(
                f"results of shards must be .jsonl files that exist, got {file}; run the missing shard"
            )
        for record in read_records(file):
            repeated += record.name in records
            records.setdefault(record.name, record)
    for record in read_records(target):
        records.setdefault(record.name, record)
    runs = [record.run for record in records.values()]
    # runs without rendering have no device
    first = next((run for run in runs if run.get("device")), runs[0] if runs else {})
    differ = {name for run in runs for name in differences(run, first)}
    writable_folder(target.parent)
    _write(target, records.values())
    return Merged(len(records), repeated, tuple(sorted(differ)))


def result_files(folders: Sequence[Path], name: str) -> list[Path]:
    """Files with results of an experiment in folders, starting with shards."""
    files = [file for folder in folders for file in sorted(folder.glob(f"{name}-*-of-*.jsonl"))]
    return files + [file for folder in folders for file in [folder / f"{name}.jsonl"] if file.is_file()]


def missing_shards(files: Iterable[Path]) -> list[str]:
    """Missing shards as "i/n", by the file names of existing shards."""
    existing: dict[int, set[int]] = {}
    for file in files:
        if match := re.fullmatch(r".*-(\d+)-of-(\d+)\.jsonl", file.name):
            existing.setdefault(int(match[2]), set()).add(int(match[1]))
    return [f"{i}/{n}" for n, found in sorted(existing.items()) for i in range(1, n + 1) if i not in found]


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Names of facts that affect results and differ; a missing device, of runs without rendering, is
    equal."""
    names = [name for name in ("versions", "code", "seed", "scene") if old.get(name) != new.get(name)]
    devices = (old.get("device"), new.get("device"))
    return names + (["device"] if None not in devices and devices[0] != devices[1] else [])


def _write(file: Path, records: Iterable[Record]) -> None:
    with atomic_write(file) as stream:
        for run, group in groupby(records, key=lambda record: record.run):
            stream.write((_header(run) + "".join(map(_line, group))).encode())


def _header(run: dict[str, Any]) -> str:
    return json.dumps({"run": run}) + "\n"


def _line(record: Record) -> str:
    # NaN and infinities are not JSON
    return json.dumps({"key": record.key, "result": record.result}, allow_nan=False) + "\n"


def rounded(value: Any) -> Any:
    """Plain data with numbers rounded to six digits."""
    if isinstance(value, dict):
        return {name: rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _call(work: Work) -> dict[str, Any]:
    return work()
