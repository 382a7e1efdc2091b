"""A short run of tools/hostile.py: inputs at random are used, or refused in one clear line."""

import contextlib
import os
import subprocess
import sys
import warnings
from pathlib import Path

import hostile
import numpy as np
import pytest
from hostile_calls import CALLS
from hostile_files import ground
from hostile_inputs import KINDS
from sampling import sampled

import fidsplat as fs

ROOT = Path(__file__).parents[2]


def run(*words):
    command = [sys.executable, str(ROOT / "tools" / "hostile.py"), *map(str, words)]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path})


@pytest.mark.parametrize("seed", sampled(range(6), 1, 0))
def test_inputs_at_random(seed):
    """8 of each kind."""
    done = run("--count", 8 * len(KINDS), "--seed", seed)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("\n| ") == len(KINDS)


ODD = (object(), np.zeros((0, 3)), 10**400, "\ud800", float("nan"))


@pytest.mark.parametrize("name", sorted(CALLS))
def test_every_argument_is_validated(name, tmp_path, monkeypatch):
    """Each argument of a public function in turn takes two values that nobody expects: it does its work, or
    refuses them with an error of ours."""
    monkeypatch.chdir(tmp_path)
    ground(tmp_path)
    monkeypatch.setattr(warnings, "showwarning", lambda *_: None)
    for number, key in enumerate(CALLS[name](tmp_path)[1]):
        for odd in (ODD[0], ODD[1 + number % 4]):
            function, good, use = CALLS[name](tmp_path)
            with contextlib.suppress(fs.FidsplatError):
                made = function(**good | {key: odd})
                if use is not None:
                    use(made)


WAYS = (
    ("raise TypeError('from inside')", "fault"),
    ("raise fidsplat.InputError('one line\\ntwo') from None", "one line"),
    ("__import__('warnings').warn('numpy', RuntimeWarning)", "fault"),
    ("__import__('os')._exit(3)", "crash"),
    ("bytearray(1 << 40)", "memory"),
)


def with_broken_loader(folder, first, *words):
    """A run of the tool whose loader of scenes ends in one of the WAYS after the other, from number `first`
    on."""
    count = folder / "count"
    count.write_text("x" * first)
    (folder / "sitecustomize.py").write_text(
        "import fidsplat, fidsplat.scenes, pathlib\n"
        f"WAYS, count = {[broken for broken, _ in WAYS]!r}, pathlib.Path({str(count)!r})\n"
        "def load(path):\n"
        "    done = count.read_text()\n"
        "    count.write_text(done + 'x')\n"
        "    exec(WAYS[len(done)])\n"
        "fidsplat.scenes.Scene.load = staticmethod(load)\n"
    )
    command = [sys.executable, str(ROOT / "tools" / "hostile.py"), "--kinds", "scenes", *words]
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    return subprocess.run(command, capture_output=True, text=True, env=env)


def test_each_way_to_end_is_told(tmp_path):
    """By the runner of the tool itself."""
    done = with_broken_loader(tmp_path, 0, "--count", str(len(WAYS)))
    told = [line.partition(" after")[0] for line in done.stdout.splitlines() if line.startswith("scenes ")]
    bad = [f"scenes {i}: {ending}" for i, (_, ending) in enumerate(WAYS) if ending != "one line"]
    assert told == bad, done.stdout + done.stderr
    assert "| scenes | 0 | 1 | 2 | 0 | 1 | 1 |" in done.stdout
    assert done.returncode == 1


def test_the_one_that_is_asked_for_is_told_though_it_ends_well(tmp_path):
    done = with_broken_loader(tmp_path, 1, "--only", "3")
    assert "scenes 3: one line " in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0


def test_an_error_may_follow_a_bar_and_nothing_else():
    bad = ("fidsplat: a\nfidsplat: b", "fidsplat: a\nTraceback", "fidsplat: a (a fault of fidsplat)", "")
    assert {hostile._ending_of_a_command(2, err)[0] for err in bad} == {"fault"}
    good = ("fidsplat: a\n", "reading 50 %\nfidsplat: a\n", "fidsplat: warning: b\nfidsplat: a")
    assert {hostile._ending_of_a_command(2, err)[0] for err in good} == {"one line"}
