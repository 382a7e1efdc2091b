"""Plants bugs one at a time in a copy of the tree, runs the tests that can see each, and counts the caught.

    python tools/mutate.py --list                        the plants of tools/mutations.toml, by area
    python tools/mutate.py --area formats --area scenes  plants of some areas; all without it
    python tools/mutate.py --sample 30 --seed 1          some of them, the same for the same seed
    python tools/mutate.py --survived                    what is not known, and again what survived
    python tools/mutate.py --table                       what is known so far, without running anything

What was found stands in mutations.jsonl, a line for each plant, and is not run again (but with --again), so
that a run that was stopped goes on where it was. A plant is caught when a test fails, crashes, or hangs. Each
set of tests is run once without a bug first: where it does not pass then, its plants are reported as
untested, not as caught. The tree is copied as it is, changes that are not committed among them, and nothing
in it is touched. All plants take hours; those of formats, cameras, scenes, markers and splats seconds each.
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
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[1]
PLANTS = Path(__file__).with_name("mutations.toml")
RESULTS = "mutations.jsonl"
CLEAN_LIMIT = 1800.0
"""seconds that a set of tests may take without a bug"""
HANGS = 4.0, 60.0
"""tests hang that take so many times what they take without the bug, and so many seconds more"""
PASSED, FAILED, STOPPED, TIMED_OUT = 0, 1, 2, 124
"""exit statuses of pytest: 2 is a module that cannot even be imported; 3 to 5 say that it did not run"""


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

    @property
    def name(self) -> str:
        return f"{self.path}: {self.wrong}"

    @property
    def key(self) -> str:
        """Differs when the plant or its tests do."""
        return hashlib.blake2b(repr(self).encode(), digest_size=8).hexdigest()


def read_plants(file: Path = PLANTS) -> list[Plant]:
    """The plants of a file, in its order."""
    data = tomllib.loads(file.read_text("utf-8"))
    only = data["only"]
    plants = []
    for entry in data["files"]:
        tests = tuple(entry["tests"])
        expression = entry.get("only", only.get(entry["area"]))
        tests += ("-k", expression) if expression else ()
        plants += [Plant(entry["path"], entry["area"], tests, *plant) for plant in entry["plants"]]
    return plants


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
        self._known = {row["key"]: row for row in map(json.loads, lines)}

    def of(self, plant: Plant) -> str | None:
        """`caught`, `survived`, `untested`, or None where it has not been run."""
        row = self._known.get(plant.key)
        return row["result"] if row else None

    def add(self, plant: Plant, result: str, seconds: float, by: str) -> None:
        row = {
            **{"key": plant.key, "plant": plant.name, "result": result, "by": by},
            **{"seconds": round(seconds, 1), "date": date.today().isoformat()},
        }
        with self._lock:
            self._known[plant.key] = row
            with self._file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(row) + "\n")


def run_tests(tree: Path, tests: Iterable[str], limit: float) -> tuple[int, str, float]:
    """pytest's exit status in a tree, the first test that failed, and seconds."""
    # bytecode is known by size and second of its source, which a plant may share with what it changes
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", "-p", "no:cacheprovider", *tests]
    begun = time.monotonic()
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        child = subprocess.Popen(
            command, cwd=tree, env=environment, stdout=output, stderr=output, start_new_session=True
        )
        try:
            status = child.wait(limit)
        except subprocess.TimeoutExpired:
            status = TIMED_OUT
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)  # what it has started, too
                child.wait()
        output.seek(0)
        failed = re.search(r"^(?:FAILED|ERROR) (\S+)", output.read(), re.MULTILINE)
    return status, failed[1] if failed else "", time.monotonic() - begun


class Garden:
    """Copies of the tree in which plants are tried, one for each job."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self._free: SimpleQueue[Path] = SimpleQueue()
        self._clean: dict[tuple[str, ...], tuple[bool, float]] = {}
        self._locks: dict[tuple[str, ...], threading.Lock] = {}
        listed = ["git", "-C", str(ROOT), "ls-files", "-z", "-c", "-o", "--exclude-standard"]
        files = subprocess.run(listed, check=True, capture_output=True, text=True).stdout.split("\0")
        for job in range(jobs):
            tree = folder / str(job)
            for name in filter(None, files):
                if (ROOT / name).is_file():
                    (tree / name).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy2(ROOT / name, tree / name)
            self._free.put(tree)

    def try_plant(self, plant: Plant) -> tuple[str, float, str]:
        """Its result, seconds, and the test that caught it."""
        tree = self._free.get()
        try:
            passes, usual = self._without_a_bug(tree, plant.tests)
            if not passes:
                return "untested", usual, "its tests fail without it"
            file = tree / plant.path
            text = file.read_text("utf-8")
            file.write_text(planted(text, plant), "utf-8")
            try:
                status, by, seconds = run_tests(tree, plant.tests, HANGS[0] * usual + HANGS[1])
            finally:
                file.write_text(text, "utf-8")
        finally:
            self._free.put(tree)
        if status == PASSED:
            return "survived", seconds, ""
        if status in (FAILED, STOPPED):
            return "caught", seconds, by
        if status == TIMED_OUT or status < 0:
            return "caught", seconds, "hangs" if status == TIMED_OUT else f"signal {-status}"
        return "untested", seconds, f"pytest ended with {status}"

    def _without_a_bug(self, tree: Path, tests: tuple[str, ...]) -> tuple[bool, float]:
        """Whether a set of tests passes, and its seconds; run once."""
        with self._locks.setdefault(tests, threading.Lock()):
            if tests not in self._clean:
                status, _, seconds = run_tests(tree, tests, CLEAN_LIMIT)
                self._clean[tests] = status == PASSED, seconds
            return self._clean[tests]


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


def main() -> int:
    plants = read_plants()
    areas = sorted({plant.area for plant in plants})
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--area", action="append", default=[], choices=areas)
    parser.add_argument("--sample", type=int, metavar="N", help="that many of them, at random")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--jobs", type=int, default=1, help="copies of the tree that are worked in at once")
    parser.add_argument("--results", type=Path, default=Path(RESULTS), help=f"file (default {RESULTS})")
    parser.add_argument("--again", action="store_true", help="run what is known, too")
    parser.add_argument("--survived", action="store_true", help="of what is known run what survived, too")
    parser.add_argument("--list", action="store_true", help="print the plants and end")
    parser.add_argument("--table", action="store_true", help="print what is known and end")
    words = parser.parse_args()
    wanted = chosen(plants, words.area, words.sample, words.seed)
    if words.list:
        print("\n".join(f"{plant.area:14} {plant.name}" for plant in wanted))
        return 0
    results = Results(words.results)
    if not words.table:
        still_open = (None, "untested", "survived") if words.survived else (None, "untested")
        waiting = [plant for plant in wanted if words.again or results.of(plant) in still_open]

        def run(plant: Plant) -> None:
            result, seconds, by = garden.try_plant(plant)
            results.add(plant, result, seconds, by)
            print(f"{result:9}{seconds:7.1f} s  {plant.name}", flush=True)

        with tempfile.TemporaryDirectory(prefix="mutate-") as folder:
            garden = Garden(Path(folder), words.jobs)
            pool = ThreadPoolExecutor(words.jobs)
            try:
                list(pool.map(run, waiting))
            finally:
                pool.shutdown(cancel_futures=True)  # Ctrl-C ends after what is under way
    print(table(wanted, results))
    return 1 if any(results.of(plant) == "survived" for plant in wanted) else 0


if __name__ == "__main__":
    sys.exit(main())
