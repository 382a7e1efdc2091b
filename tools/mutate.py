"""Plants bugs one at a time in a copy of the tree, runs the tests that can see each, and counts the caught.

    python tools/mutate.py --list                        the plants of tools/mutations.toml, by area
    python tools/mutate.py --area formats --area scenes  plants of some areas; all without it
    python tools/mutate.py --sample 30 --seed 1          some of them, the same for the same seed
    python tools/mutate.py --path schedule/ --jobs 4     those of files with that in their path, four at once
    python tools/mutate.py --device pocl --minutes 9     on one device only; what is not done then is left
    python tools/mutate.py --survived                    what is not known, and again what survived
    python tools/mutate.py --table                       what is known so far, without running anything

What was found stands in mutations.jsonl, a line for each plant, and is not run again (but with --again), so
that a run that was stopped goes on where it was. Each file's first plants come first. A plant is caught when
a test fails, crashes, or hangs, and that test passes without the plant; a test that fails then too is passed
over. A plant is first shown to the test that caught it before, even if its text has changed since, then to
those that it names itself. The tree is copied as a source distribution has it, changes that are not committed
among them, and nothing in it is touched. All plants take hours on two cores; those of formats, cameras,
scenes, markers and splats seconds each.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[1]
PLANTS = Path(__file__).with_name("mutations.toml")
RESULTS = "mutations.jsonl"
SILENT = 240.0
"""seconds without a test begun or ended after which tests hang"""
PASSED, FAILED, STOPPED = 0, 1, 2
"""exit statuses of pytest: 2 is a module that cannot even be imported; 3 to 5 say that it did not run"""
HANGS, TOO_LATE = "hangs", "too late"


@dataclass(frozen=True)
class Plant:
    """One bug."""

    path: str
    """of the file, from the root"""
    area: str
    tests: tuple[str, ...]
    """arguments of pytest"""
    old: str
    new: str
    wrong: str
    """what is wrong then"""
    first: tuple[str, ...] = ()
    """arguments of pytest for the few of these tests that are tried first, if any"""

    @property
    def name(self) -> str:
        return f"{self.path}: {self.wrong}"

    @property
    def key(self) -> str:
        """Differs when the plant does."""
        said = repr((self.path, self.old, self.new))
        return hashlib.blake2b(said.encode(), digest_size=8).hexdigest()


def read_plants(file: Path = PLANTS, device: str | None = None) -> list[Plant]:
    """The plants of a file, in its order; their tests on every device, or on one with that in its name."""
    data = tomllib.loads(file.read_text("utf-8"))
    only = data["only"]
    here = [f"({device} or not (opencl: or warp:))"] if device else []
    plants = []
    for entry in data["files"]:
        expression = entry.get("only", only.get(entry["area"]))
        wanted = [*([f"({expression})"] if expression else []), *here]
        tests = _of(entry["tests"], wanted)
        for old, new, wrong, *first in entry["plants"]:
            few = _of(entry["tests"], [*wanted, f"({first[0]})"]) if first else ()
            plants.append(Plant(entry["path"], entry["area"], tests, old, new, wrong, few))
    return plants


def _of(tests: list[str], wanted: list[str]) -> tuple[str, ...]:
    """Arguments of pytest for those of the tests that are wanted."""
    return (*tests, *(("-k", " and ".join(wanted)) if wanted else ()))


def planted(text: str, plant: Plant) -> str:
    """A file's text with the bug. Raises ValueError unless what it replaces stands there exactly once."""
    count = text.count(plant.old)
    if count != 1 or plant.old == plant.new:
        raise ValueError(f"{plant.name}: its old text stands {count} times in the file; mend {PLANTS.name}")
    return text.replace(plant.old, plant.new)


class Results:
    """What is known of each plant, kept in a file of JSON lines; later lines hold."""

    def __init__(self, file: Path) -> None:
        self._file, self._lock = file, threading.Lock()
        lines = file.read_text("utf-8").splitlines() if file.exists() else []
        rows = [json.loads(line) for line in lines]
        self._known = {row["key"]: row for row in rows}
        self._tests = {row["plant"]: row["test"] for row in rows if row["result"] == "caught"}

    def of(self, plant: Plant) -> str | None:
        """`caught`, `survived`, `untested`, or None where it has not been run."""
        return self._known.get(plant.key, {}).get("result")

    def test_of(self, plant: Plant) -> str | None:
        """The test that has caught it, or what had its name before the text there changed."""
        return self._tests.get(plant.name)

    def add(self, plant: Plant, found: Found) -> None:
        row = {
            **{"key": plant.key, "plant": plant.name, "result": found.result, "test": found.test},
            **{"how": found.how, "seconds": round(found.seconds, 1), "date": date.today().isoformat()},
        }
        with self._lock:
            self._known[plant.key] = row
            if found.result == "caught":
                self._tests[plant.name] = found.test
            with self._file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(row) + "\n")


@dataclass(frozen=True)
class Found:
    """What became of one plant."""

    result: str
    """`caught`, `survived` or `untested`"""
    test: str
    """that caught it, or stood in the way"""
    how: str
    """`fails`, `hangs`, a signal"""
    seconds: float


@dataclass(frozen=True)
class Run:
    """One run of pytest."""

    how: int | str
    """its exit status, HANGS or TOO_LATE"""
    test: str
    """the first that failed, or the one under way when it ended"""


def run_tests(tree: Path, tests: Sequence[str], deadline: float = float("inf")) -> Run:
    """pytest in a tree, to its first failure."""
    # bytecode is known by size and second of its source, which a plant may share with what it changes
    path = os.pathsep.join(filter(None, [str(tree), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "1000"}
    command = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-v", "-p", "no:cacheprovider", *tests]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        child = subprocess.Popen(
            command, cwd=tree, env=environment, stdout=output, stderr=output, start_new_session=True
        )
        try:
            how = _watched(child, output.fileno(), deadline)
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)  # what it has started, too
                child.wait()
        output.seek(0)
        said = output.read()
    failed = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", said, re.MULTILINE)
    begun = re.findall(r"^(\S+\.py::.*?)(?: (?:PASSED|SKIPPED|FAILED|ERROR|Fatal)\b.*)?$", said, re.MULTILINE)
    return Run(how, failed[1] if failed else begun[-1].strip() if begun else "")


def _watched(child: subprocess.Popen[bytes], output: int, deadline: float) -> int | str:
    """How it ends: its exit status, HANGS or TOO_LATE."""
    size, since = 0, time.monotonic()
    while True:
        try:
            return child.wait(0.1)
        except subprocess.TimeoutExpired:
            now, grown = time.monotonic(), os.fstat(output).st_size
        if grown > size:
            size, since = grown, now
        if now > deadline:
            return TOO_LATE
        if now > since + SILENT:
            return HANGS


def copy_tree(to: Path) -> None:
    """What a source distribution has of the tree."""
    build = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]
    to.mkdir(parents=True)
    for name in ("pyproject.toml", *(name.strip("/") for name in build["targets"]["sdist"]["include"])):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, to / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif (ROOT / name).exists():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)


def _alone(test: str) -> tuple[str, ...]:
    """Arguments of pytest for one test, which may be marked as left out of sweeps once it is by itself
    (`in_turn` of tests/sampling.py)."""
    return (test, "-m", "")


class Garden:
    """Copies of the tree in which plants are tried, one for each job."""

    def __init__(self, folder: Path, jobs: int, deadline: float = float("inf")) -> None:
        self._deadline = deadline
        self._free: SimpleQueue[Path] = SimpleQueue()
        self._passes: dict[str, bool] = {}
        for job in range(jobs):
            copy_tree(folder / str(job))
            self._free.put(folder / str(job))

    def try_plant(self, plant: Plant, before: str | None = None) -> Found | None:
        """What becomes of it, `before` being the test that caught it once; None when time is over."""
        tree, begun = self._free.get(), time.monotonic()
        likely = [tests for tests in (_alone(before) if before else (), plant.first) if tests]
        try:
            for tests in likely:
                if (found := self._try(tree, plant, tests)) and found[0] == "caught":
                    return Found(*found, time.monotonic() - begun)
            found = self._try(tree, plant, plant.tests)
            return Found(*found, time.monotonic() - begun) if found else None
        finally:
            self._free.put(tree)

    def _try(self, tree: Path, plant: Plant, tests: tuple[str, ...]) -> tuple[str, str, str] | None:
        """Result, test and how it ended."""
        file = tree / plant.path
        text = file.read_text("utf-8")
        while True:
            if time.monotonic() > self._deadline:
                return None
            broken = [
                word for test, passes in self._passes.items() if not passes for word in ("--deselect", test)
            ]
            file.write_text(planted(text, plant), "utf-8")
            try:
                run = run_tests(tree, (*tests, *broken), self._deadline)
            finally:
                file.write_text(text, "utf-8")
            if run.how == TOO_LATE:
                return None
            if run.how == PASSED:
                return "survived", "", ""
            if (isinstance(run.how, int) and run.how > STOPPED) or not run.test:
                return "untested", run.test, f"pytest ended with {run.how}"
            passes = self._passes_without(tree, run.test)
            if passes is None:
                return None
            if passes:
                how = (
                    run.how
                    if run.how == HANGS
                    else "fails"
                    if run.how in (FAILED, STOPPED)
                    else f"signal {run.how}"
                )
                return "caught", run.test, str(how)
            if run.test in broken or "::" not in run.test:
                return "untested", run.test, "fails without it"

    def _passes_without(self, tree: Path, test: str) -> bool | None:
        """Whether a test, or the import of a module of tests, passes without a bug. None: too late."""
        if test not in self._passes:
            run = run_tests(tree, _alone(test) if "::" in test else (test, "--collect-only"), self._deadline)
            if run.how == TOO_LATE:
                return None
            self._passes[test] = run.how == PASSED
        return self._passes[test]


def table(plants: list[Plant], results: Results) -> str:
    """Markdown: caught and survived by area, and below it those that survived."""
    rows = ["| area | plants | run | caught | survived |", "|---|---|---|---|---|"]
    areas = list(dict.fromkeys(plant.area for plant in plants))
    for area in (*areas, None):
        own = [plant for plant in plants if area in (plant.area, None)]
        found = [results.of(plant) for plant in own]
        caught, survived = found.count("caught"), found.count("survived")
        name = "all" if area is None else area
        rows.append(f"| {name} | {len(own)} | {caught + survived} | {caught} | {survived} |")
    for result in ("survived", "untested"):
        names = [plant.name for plant in plants if results.of(plant) == result]
        rows += ["", f"{result}:", *(f"- {name}" for name in names)] if names else []
    return "\n".join(rows)


def chosen(plants: list[Plant], areas: list[str], sample: int | None, seed: int) -> list[Plant]:
    """Plants of some areas (all of none), or a sample of those, in the order of the file."""
    plants = [plant for plant in plants if not areas or plant.area in areas]
    if sample is None or sample >= len(plants):
        return plants
    return sorted(random.Random(seed).sample(plants, sample), key=plants.index)


def by_turns(plants: list[Plant]) -> list[Plant]:
    """The first plant of each file, then the second of each: what a short run learns most from."""
    seen: Counter[str] = Counter()
    turns = []
    for plant in plants:
        turns.append(seen[plant.path])
        seen[plant.path] += 1
    return [plant for _, plant in sorted(zip(turns, plants, strict=True), key=lambda pair: pair[0])]


def run_all(waiting: list[Plant], results: Results, jobs: int, deadline: float) -> None:
    """Try them, several at once, and keep what is found."""

    def run(plant: Plant) -> None:
        found = garden.try_plant(plant, results.test_of(plant))
        if found:
            results.add(plant, found)
            print(f"{found.result:9}{found.seconds:7.1f} s  {plant.name}  [{found.test}]", flush=True)

    with tempfile.TemporaryDirectory(prefix="mutate-") as folder:
        garden = Garden(Path(folder), jobs, deadline)
        pool = ThreadPoolExecutor(jobs)
        try:
            list(pool.map(run, waiting))
        finally:
            pool.shutdown(cancel_futures=True)  # Ctrl-C ends after what is under way


def main() -> int:
    areas = sorted({plant.area for plant in read_plants()})
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--area", action="append", default=[], choices=areas)
    parser.add_argument("--path", default="", help="of files that have this in their path")
    parser.add_argument("--device", help="run tests that take a device on those with this in their name")
    parser.add_argument("--sample", type=int, metavar="N", help="that many of them, at random")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--jobs", type=int, default=1, help="copies of the tree that are worked in at once")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="leave what is not done then")
    parser.add_argument("--results", type=Path, default=Path(RESULTS), help=f"file (default {RESULTS})")
    parser.add_argument("--again", action="store_true", help="run what is known, too")
    parser.add_argument("--survived", action="store_true", help="of what is known run what survived, too")
    parser.add_argument("--list", action="store_true", help="print the plants and end")
    parser.add_argument("--table", action="store_true", help="print what is known and end")
    words = parser.parse_args()
    deadline = time.monotonic() + 60 * words.minutes
    plants = [plant for plant in read_plants(device=words.device) if words.path in plant.path]
    wanted = chosen(plants, words.area, words.sample, words.seed)
    if words.list:
        print("\n".join(f"{plant.area:14} {plant.name}" for plant in wanted))
        return 0
    results = Results(words.results)
    if not words.table:
        still_open = (None, "untested", "survived") if words.survived else (None, "untested")
        waiting = [plant for plant in wanted if words.again or results.of(plant) in still_open]
        run_all(by_turns(waiting), results, words.jobs, deadline)
    print(table(wanted, results))
    return 1 if any(results.of(plant) == "survived" for plant in wanted) else 0


if __name__ == "__main__":
    sys.exit(main())
