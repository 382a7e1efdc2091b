"""A short run of tools/hostile.py: inputs at random are used, or refused in one clear line."""

import os
import subprocess
import sys
from pathlib import Path

import hostile
import pytest
from hostile_inputs import KINDS
from sampling import sampled

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


@pytest.mark.parametrize(
    ("broken", "ending"),
    [
        ("raise TypeError('from inside')", "fault"),
        ("raise fidsplat.InputError('one line\\ntwo') from None", "one line"),
        ("__import__('warnings').warn('numpy', RuntimeWarning)", "fault"),
        ("bytearray(1 << 40)", "memory"),
        ("__import__('os')._exit(3)", "crash"),
    ],
)
def test_each_way_to_end_is_told(tmp_path, broken, ending):
    """The runner of the tool itself, with a loader of scenes that ends in each way."""
    (tmp_path / "sitecustomize.py").write_text(
        "import fidsplat, fidsplat.scenes\n"
        f"def load(path):\n    {broken}\n"
        "fidsplat.scenes.Scene.load = staticmethod(load)\n"
    )
    command = [sys.executable, str(ROOT / "tools" / "hostile.py"), "--kinds", "scenes", "--only", "3"]
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert f"scenes 3: {ending} " in done.stdout, done.stdout + done.stderr
    assert done.returncode == (0 if ending == "one line" else 1)


def test_an_error_may_follow_a_bar_and_nothing_else():
    bad = ("fidsplat: a\nfidsplat: b", "fidsplat: a\nTraceback", "fidsplat: a (a fault of fidsplat)", "")
    assert {hostile._ending_of_a_command(2, err)[0] for err in bad} == {"fault"}
    good = ("fidsplat: a\n", "reading 50 %\nfidsplat: a\n", "fidsplat: warning: b\nfidsplat: a")
    assert {hostile._ending_of_a_command(2, err)[0] for err in good} == {"one line"}
