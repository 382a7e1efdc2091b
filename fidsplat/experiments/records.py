"""Results in JSON lines: one line for each finished part, so that a run that is stopped goes on, shards of it
are joined, and every number keeps the device, versions, commit and seed that it came from."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from fidsplat.errors import InputError
from fidsplat.files import atomic_write, ordinary_file, writable_folder


def _differences(old: dict, new: dict) -> list[str]:
    """The facts on which numbers depend and that are not the same. A run that draws nothing has no device."""
    names = [name for name in ("versions", "code", "seed") if old.get(name) != new.get(name)]
    devices = (old.get("device"), new.get("device"))
    return names + (["device"] if None not in devices and devices[0] != devices[1] else [])


class Records:
    """The lines of one file.

    Args:
        file: made when it is missing.
        run: `fidsplat.provenance.run_facts` of this run.
        anew: drop what the file holds.

    Raises InputError when the file cannot be written, is none of ours, or holds results of another device,
    version or seed.
    """

    def __init__(self, file: Path, run: dict, anew: bool = False) -> None:
        writable_folder(file.parent)
        self.file, self.run = ordinary_file(file), run
        lines = [] if anew else read_lines(file)
        for line in lines:
            differ = _differences(line.get("run", {}), run)
            if differ:
                raise InputError(
                    f"{file} holds results of another {' and '.join(differ)}; give another folder with -o, "
                    "or --anew to measure again"
                )
        self.done = {key_of(line): line for line in lines}
        # what a killed run left half written goes; so does all with --anew
        if anew or file.exists():
            _write(file, self.done.values())

    def measure(self, work: Iterable[dict], measure: Callable[[dict], dict]) -> Iterator[tuple[int, dict]]:
        """Measure what is not done yet; yields (parts done so far, the line) after each, old ones first."""
        parts = [{**part} for part in work]
        keys = [_canonical(part) for part in parts]
        count = 0
        for key in keys:
            if key in self.done:
                count += 1
                yield count, self.done[key]
        for key, part in zip(keys, parts, strict=True):
            if key in self.done:
                continue
            count += 1
            yield count, self.append(part, measure(part))

    def append(self, part: dict, result: dict) -> dict:
        """Keep the result of a part at once; returns its line."""
        line = {"key": part, "result": result, "run": self.run}
        with open(self.file, "a", encoding="utf-8") as stream:
            stream.write(_dump(line))
            stream.flush()
            os.fsync(stream.fileno())
        self.done[_canonical(part)] = line
        return line

    def missing(self, work: Iterable[dict]) -> int:
        """How many parts are not done yet."""
        return len(self.left(work))

    def left(self, work: Iterable[dict]) -> list[dict]:
        """The parts that are not done yet, in their order."""
        return [part for part in work if _canonical(part) not in self.done]


def key_of(line: dict) -> str:
    """What a line is about, as one string."""
    return _canonical(line["key"])


def _canonical(key: dict) -> str:
    return json.dumps(key, sort_keys=True)


def _dump(line: dict) -> str:
    # NaN and infinities are not JSON: a result that has them is a fault, found here
    return json.dumps(line, allow_nan=False) + "\n"


def _write(file: Path, lines: Iterable[dict]) -> None:
    with atomic_write(file) as stream:
        for line in lines:
            stream.write(_dump(line).encode())


def read_lines(file: Path) -> list[dict]:
    """Every whole line of a file, [] when it is missing; a last line that was cut short is left out.

    Raises InputError when another line is none of ours.
    """
    try:
        text = file.read_text("utf-8")
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {file}: {error}") from error
    lines = text.split("\n")
    found = []
    for number, line in enumerate(lines[:-1], 1):
        try:
            value = json.loads(line)
            if not (isinstance(value["key"], dict) and isinstance(value["result"], dict)):
                raise TypeError
        except (ValueError, KeyError, TypeError):
            raise InputError(
                f"{file}, line {number}: not a result of fidsplat; give another folder with -o"
            ) from None
        found.append(value)
    return found


def shard(work: list[dict], text: str | None) -> list[dict]:
    """Every n-th part, from the i-th on, of "i/n"; all of them for None.

    Raises InputError for anything but i/n with 1 <= i <= n.
    """
    if text is None:
        return work
    first, _, of = text.partition("/")
    if not (first.isdecimal() and of.isdecimal() and 1 <= int(first) <= int(of)):
        raise InputError(f"--shard is {text!r}; write i/n with 1 <= i <= n, e.g. 1/4")
    return work[int(first) - 1 :: int(of)]


class Merged(NamedTuple):
    """What `merge` found."""

    lines: int
    repeated: int
    """parts that more than one file had"""
    differ: tuple[str, ...]
    """facts on which numbers depend and that are not the same in all lines"""


def merge(files: list[Path], target: Path) -> Merged:
    """Join files of shards into one; of a part that several have the first stays.

    What the target holds already and the files do not stays in it.

    Raises InputError when a file is missing or none of ours.
    """
    for file in files:
        if not file.is_file():
            raise InputError(f"{file} is not a file; give the .jsonl files of the shards")
    found: dict[str, dict] = {}
    twice = 0
    for file in files:
        for line in read_lines(file):
            twice += key_of(line) in found
            found.setdefault(key_of(line), line)
    for line in read_lines(target):
        found.setdefault(key_of(line), line)
    lines = list(found.values())
    runs = [line.get("run", {}) for line in lines]
    # one that draws nothing has no device to differ from
    first = next((run for run in runs if run.get("device")), runs[0] if runs else {})
    differ = {name for run in runs for name in _differences(run, first)}
    writable_folder(target.parent)
    _write(target, lines)
    return Merged(len(lines), twice, tuple(sorted(differ)))


def missing_shards(files: Iterable[Path]) -> list[str]:
    """The "i/n" that are not among files named as `--shard i/n` names them."""
    there: dict[int, set[int]] = {}
    for file in files:
        if match := re.fullmatch(r".*-(\d+)-of-(\d+)\.jsonl", file.name):
            there.setdefault(int(match[2]), set()).add(int(match[1]))
    return [f"{i}/{n}" for n, found in sorted(there.items()) for i in range(1, n + 1) if i not in found]
