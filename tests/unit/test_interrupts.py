"""Signals and full disks: the short form of tools/interrupt.py."""

import os
import shutil
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future

import interrupt
import pytest

from fidsplat.util import interrupts

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
WHERE_EXCEPTIONS_ARE_DROPPED = """
import os, signal, sys, weakref
from fidsplat import cli
from fidsplat.util import interrupts
from fidsplat.commands import COMMANDS

class Finalised:
    def __del__(self):
        os.kill(os.getpid(), signal.{name})

def run(self):
    Finalised()
    {then}
    return 0

COMMANDS["devices"].run = run
sys.exit(cli.main(["devices"]))
"""
"""sends a signal within a finalizer"""
AT_THE_START = """
import os, signal, sys

class Finder:
    def find_spec(self, name, *_):
        if name == "{module}":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Finder())
sys.argv = ["fidsplat", "devices"]
from fidsplat.__main__ import main
sys.exit(main())
"""
"""sends one when the command imports a module"""


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return interrupt.Trial(interrupt.COMMANDS["render"], tmp_path_factory.mktemp("interrupted"))


@pytest.mark.sweep
def test_an_interrupted_command_loses_nothing(trial):
    outcomes = [interrupt.disturb(trial, how, how, 0.8) for how in interrupt.SIGNALS]
    assert [row["lost"] for row in outcomes] == [[]] * 3
    assert any(row["stopped"] for row in outcomes)


@pytest.mark.parametrize(
    ("name", "status", "message"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")]
)
def test_a_library_that_is_being_loaded_is_not_interrupted(name, status, message):
    """PyOpenCL aborted the process then."""
    ended = subprocess.run(
        [sys.executable, "-c", IN_A_LIBRARY.format(name=name)], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (status, f"fidsplat: {message}\n")


@pytest.mark.parametrize(
    ("name", "then", "status", "message"),
    [
        ("SIGINT", "interrupts.check()", 130, "interrupted"),
        ("SIGTERM", "raise OSError('interrupted system call')", 143, "terminated"),
    ],
)
def test_a_signal_in_a_finalizer_is_not_lost(name, then, status, message):
    """Python discards exceptions of a finalizer: the command continued, with status 0. A later error is a
    consequence of the signal."""
    code = WHERE_EXCEPTIONS_ARE_DROPPED.format(name=name, then=then)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (status, f"fidsplat: {message}\n")


@pytest.mark.parametrize("module", ["fidsplat.cli", "tyro"])
def test_an_interrupt_at_the_start_is_one_line(module):
    code = AT_THE_START.format(module=module)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (130, "fidsplat: interrupted\n")


SILENT = (sys.executable, "-c", "import time; time.sleep(60)")


def _output_of_a_silent_process():
    with subprocess.Popen(SILENT, stdout=subprocess.PIPE) as silent:
        try:
            list(interrupts.lines_of(silent.stdout))
        finally:
            silent.kill()


@pytest.mark.parametrize(
    "waiting",
    [
        lambda: interrupts.sleep(60),
        lambda: interrupts.result_of(Future()),
        lambda: interrupts.run(SILENT),
        _output_of_a_silent_process,
    ],
    ids=["sleep", "task", "process", "output"],
)
def test_waiting_is_interrupted(waiting):
    later = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM))
    with interrupts.handled():
        later.start()
        with pytest.raises(interrupts.Terminated):
            waiting()
    interrupts.check()  # the next command begins without the flag


def test_an_awaited_result_is_returned():
    task = Future()
    task.set_result(3)
    assert interrupts.result_of(task) == 3
    done = interrupts.run([sys.executable, "-c", "print('out'); exit(4)"])
    assert (done.returncode, done.stdout) == (4, "out\n")
    with subprocess.Popen(
        [sys.executable, "-c", r"print('one\ntwo'); print('rest', end='')"], stdout=subprocess.PIPE
    ) as message:
        assert list(interrupts.lines_of(message.stdout)) == ["one", "two"]


def test_the_second_signal_does_not_wait(monkeypatch):
    with interrupts.handled(), interrupts.postponed() as stopped:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)  # the same once more, as a terminal and a parent send it
        interrupts.check()
        assert isinstance(stopped(), KeyboardInterrupt)
        monkeypatch.setattr(interrupts, "REPEAT", 0.0)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a small file system")
def test_a_full_disk_loses_nothing(trial, tmp_path):
    try:
        with interrupt.small_disk(tmp_path, 2**20):
            pass
    except subprocess.CalledProcessError:
        pytest.skip("no file system can be mounted here")
    outcomes = interrupt.disturb(trial, "full", interrupt.DISK, 0.6)
    assert (outcomes["stopped"], outcomes["lost"]) == (True, [])


def test_damage_is_found(trial):
    folder = trial.work / "damaged"
    shutil.copytree(trial.work / "second", folder)
    (folder / ".image.png.x.part").touch()
    images = sorted(name for name in interrupt.files_below(folder) if name.endswith(".png"))
    (folder / images[0]).write_bytes((folder / images[1]).read_bytes())
    (folder / images[-1]).write_bytes((folder / images[-1]).read_bytes()[:-9])
    assert [words.partition(":")[0] for words in trial.lost(folder, 1, "Traceback")] == [
        "ended with 1",
        "left .image.png.x.part",
        f"{images[0]} differs",
        f"{images[-1]} is incomplete",
    ]
