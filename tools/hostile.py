"""Hostile input: random command lines, scene files, splat files, pictures and Python calls.

    PYTHONPATH=. python tools/hostile.py --count 3000 --seed 0

Input i of a kind is made from the seed, the kind and i alone: `--kinds calls --only 17` does one again.
Every input should be used, or refused in one clear line. What ends otherwise is listed, and makes the exit
status 1. Inputs run in a process with limits of time and memory, which is replaced when one ends it.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import hostile_inputs

SECONDS = 10
"""of processor time, after which an input hangs"""
GIB = 6
"""of address space"""
ENDS = ("used", "one line", "fault", "hang", "memory", "crash")
GOOD = ("used", "one line")


class HangError(BaseException):
    """Raised by the alarm. No handler of ours may take it for an error of the input."""


def outcome(kind: str, seed: int, number: int, folder: Path) -> tuple[str, str]:
    """How an input ends, and in what words."""
    from fidsplat.util.errors import FidsplatError

    rng = random.Random(f"{seed}-{kind}-{number}")
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    out, err = io.StringIO(), io.StringIO()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            warnings.simplefilter("error")  # NumPy's own are a fault: they are not for users
            warnings.simplefilter("ignore", UserWarning)
            status = hostile_inputs.KINDS[kind](rng, folder)
        if status is None:
            return "used", ""
        return _ending_of_a_command(status, err.getvalue())
    except HangError:
        return "hang", f"more than {SECONDS} s of processor time"
    except FidsplatError as error:
        return ("one line" if "\n" not in str(error) else "fault"), str(error)
    except MemoryError as error:
        return "memory", str(error)
    except BaseException as error:
        where = error.__traceback__
        while where is not None and where.tb_next is not None:
            where = where.tb_next
        place = (
            "" if where is None else f" ({Path(where.tb_frame.f_code.co_filename).name}:{where.tb_lineno})"
        )
        notes = " ".join(getattr(error, "__notes__", ()))
        return "fault", f"{notes} {type(error).__name__}: {error}{place}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _ending_of_a_command(status: int, err: str) -> tuple[str, str]:
    lines = [line for line in err.splitlines() if line.startswith("fidsplat: ")]
    lines = [line for line in lines if not line.startswith("fidsplat: warning: ")]
    if status == 0:
        return "used", ""
    if "not enough memory" in err:
        return "memory", err
    last = err.rstrip("\n").rpartition("\n")[2]  # after a bar, where the machine was slow
    clear = lines == [last] and "a fault of fidsplat" not in last and "Traceback" not in err
    return ("one line" if clear and status in (1, 2) else "fault"), f"status {status}: {err}"


def work(kind: str, seed: int, numbers: range) -> None:
    """Do inputs one after the other and print a line of JSON for each; in a process of its own."""

    def ring(*_):
        raise HangError

    signal.signal(signal.SIGPROF, ring)
    resource.setrlimit(resource.RLIMIT_AS, (GIB << 30, GIB << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    say = sys.stdout
    with tempfile.TemporaryDirectory() as name:
        for number in numbers:
            begun = time.process_time()
            ending, words = outcome(kind, seed, number, Path(name))
            say.write(json.dumps([number, ending, words[:500], time.process_time() - begun]) + "\n")
            say.flush()


def run(kind: str, seed: int, numbers: range) -> list[tuple[int, str, str, float]]:
    """(number, ending, words, seconds) of each input, whatever becomes of the processes that do them."""
    done: list[tuple[int, str, str, float]] = []
    while len(done) < len(numbers):
        rest = numbers[len(done) :]
        span = [str(rest.start), str(rest.stop), str(rest.step)]
        command = [sys.executable, __file__, "--worker", kind, "--seed", str(seed), *span]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as worker:
            assert worker.stdout is not None
            while len(done) < len(numbers):
                # an alarm does not reach what hangs outside of Python; a new process has to load first
                ready, *_ = select.select([worker.stdout], [], [], 30 * SECONDS)
                line = worker.stdout.readline() if ready else ""
                if not line:
                    worker.kill()
                    number = numbers[len(done)]
                    ending = ("crash", f"the process ended with {worker.wait()}") if ready else ("hang", "")
                    done.append((number, *ending, 0.0))
                    break
                done.append(tuple(json.loads(line)))
    return done


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=3000, help="inputs of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--kinds", nargs="+", choices=list(hostile_inputs.KINDS), default=list(hostile_inputs.KINDS)
    )
    parser.add_argument("--only", type=int, help="the one input of this number")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("span", nargs="*", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        work(given.worker, given.seed, range(*given.span))
        return 0
    each = range(given.count // len(given.kinds)) if given.only is None else range(given.only, given.only + 1)
    table, bad = {}, 0
    for kind in given.kinds:
        found = run(kind, given.seed, each)
        table[kind] = Counter(ending for _, ending, *_ in found)
        table[kind]["slowest"] = max((seconds for *_, seconds in found), default=0.0)
        for number, ending, words, seconds in found:
            if ending not in GOOD or given.only is not None:
                bad += ending not in GOOD
                print(
                    f"{kind} {number}: {ending} after {seconds:.1f} s: {' '.join(words.split())}", flush=True
                )
    print(f"| input | {' | '.join(ENDS)} | slowest |\n|{'---|' * (len(ENDS) + 2)}")
    for kind, counts in table.items():
        print(f"| {kind} | {' | '.join(str(counts[end]) for end in ENDS)} | {counts['slowest']:.1f} s |")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
