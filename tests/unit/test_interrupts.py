"""Signals and full disks: the short form of tools/interrupt.py."""

import json
import os
import shutil
import subprocess
import sys

import interrupt
import pytest

IN_A_LIBRARY = """
import os, signal, sys
from fidsplat.cli import main

def stop(frame, event, argument):
    caller = frame.f_back and frame.f_back.f_back
    if event == "call" and caller and caller.f_code.co_qualname == "ExtensionFileLoader.exec_module":
        if caller.f_locals["self"].name == "pyopencl._cl":
            sys.setprofile(None)
            os.kill(os.getpid(), signal.{name})

sys.setprofile(stop)
sys.exit(main(["devices"]))
"""
"""sends a signal when PyOpenCL calls Python while it is loaded"""
IN_A_QUESTION = """
import abc, os, signal, sys, time
import numpy as np
from fidsplat.interrupts import raised_in_time

def stop(frame, event, argument):
    if event == "call" and frame.f_code is abc.ABCMeta.__instancecheck__.__code__:
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGINT)

with raised_in_time(), open(os.devnull, "wb") as file:
    sys.setprofile(stop)
    try:
        np.save(file, np.zeros(3))
        time.sleep(10)
    except KeyboardInterrupt:
        print("interrupted")
"""
"""sends one when NumPy asks whether the file that it saves to is a path"""


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return interrupt.Trial(interrupt.COMMANDS["render"], tmp_path_factory.mktemp("interrupted"))


def test_an_interrupted_command_loses_nothing(trial):
    found = [interrupt.disturb(trial, how, how, 0.8) for how in interrupt.SIGNALS]
    assert [row["lost"] for row in found] == [[]] * 3
    assert any(row["stopped"] for row in found)


@pytest.mark.parametrize(
    ("name", "status", "said"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")]
)
def test_a_library_that_is_being_loaded_is_not_interrupted(name, status, said):
    """PyOpenCL aborted the process then."""
    ended = subprocess.run(
        [sys.executable, "-c", IN_A_LIBRARY.format(name=name)], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (status, f"fidsplat: {said}\n")


def test_a_question_of_numpys_is_not_interrupted():
    """It took the exception for a yes, and said that a file is no path."""
    ended = subprocess.run([sys.executable, "-c", IN_A_QUESTION], capture_output=True, text=True, check=False)
    assert (ended.stdout, ended.stderr) == ("interrupted\n", "")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a small file system")
def test_a_full_disk_loses_nothing(trial, tmp_path):
    try:
        with interrupt.small_disk(tmp_path, 2**20):
            pass
    except subprocess.CalledProcessError:
        pytest.skip("no file system can be mounted here")
    assert interrupt.disturb(trial, "full", interrupt.DISK, 0.6) == {"stopped": True, "lost": []}


def test_what_is_lost_is_seen(trial):
    folder = trial.work / "damaged"
    shutil.copytree(trial.work / "second", folder)
    (folder / ".picture.png.x.part").touch()
    pictures = sorted(name for name in interrupt.files_below(folder) if name.endswith(".png"))
    (folder / pictures[0]).write_bytes((folder / pictures[1]).read_bytes())
    (folder / pictures[-1]).write_bytes((folder / pictures[-1]).read_bytes()[:-9])
    assert [words.partition(":")[0] for words in trial.lost(folder, 1, "Traceback")] == [
        "ended with 1",
        "left .picture.png.x.part",
        f"{pictures[0]} differs",
        f"{pictures[-1]} is not whole",
    ]


def test_logs_and_figures_by_their_values(tmp_path):
    log = tmp_path / "rows.jsonl"
    log.write_text('{"run": {}}\n{"key": {"n": 1}, "result": {"a": [1, 2]}}\n{"key": {')
    assert interrupt.facts(log) == {('{"n": 1}', "a", 0): 1, ('{"n": 1}', "a", 1): 2}
    log.write_text('{"key": {"n": 1\n{"key": {"n": 2}, "result": {}}\n')
    with pytest.raises(json.JSONDecodeError):
        interrupt.facts(log)
    figures = tmp_path / "figures.json"
    figures.write_text('{"a": {"b": 1}}\n')
    assert interrupt.facts(figures) == {("a", "b"): 1}
    figures.write_text('{"a": ')
    with pytest.raises(json.JSONDecodeError):
        interrupt.facts(figures)


def test_charts_of_times_need_only_be_whole(tmp_path):
    chart = tmp_path / "seconds.svg"
    chart.write_text("<svg>\n</svg>\n")
    assert interrupt.facts(chart) == {}
    chart.write_text("<svg>\n</sv")
    with pytest.raises(ValueError, match="cut off"):
        interrupt.facts(chart)


def test_how_a_run_may_end():
    assert interrupt.is_clear(0, "")
    assert interrupt.is_clear(143, "half of a bar\nfidsplat: terminated")
    assert interrupt.is_clear(-2, "Traceback ...\n  File site.py, line 3, in getpath\nKeyboardInterrupt")
    assert not interrupt.is_clear(-2, "Traceback ...\n  File cli.py, line 3, in main\nKeyboardInterrupt")
    assert not interrupt.is_clear(143, "fidsplat: terminated\nException ignored in\nTraceback")
    assert not interrupt.is_clear(1, "OSError: [Errno 28]")
    assert not interrupt.is_clear(
        1, "fidsplat: OSError: [Errno 28] (a fault of fidsplat; --debug shows where)"
    )


def test_the_trials_are_planned_alike_each_time():
    plans = {name: interrupt.planned(name, 0) for name in interrupt.COMMANDS}
    assert plans == {name: interrupt.planned(name, 0) for name in interrupt.COMMANDS}
    kills = {name: sum(how != interrupt.DISK for how, _ in plan.values()) for name, plan in plans.items()}
    assert all(kills[name] > 50 for name in ("render", "demo", "tradeoff", "experiment"))
    assert sum(map(len, plans.values())) > 300
