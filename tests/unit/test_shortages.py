"""The command line if a resource is missing: a stream, memory, files, folders."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

import fidsplat as fs

ROOT = Path(__file__).parents[2]
FIDSPLAT = f"{sys.executable} -m fidsplat"
NO_ROOM = "fidsplat: No space left on device; free space there or on the disk of the output"


def shell(text, folder, **environment):
    """Exit status, stdout and stderr of a line of a shell, in which `fidsplat` is this installation."""
    done = subprocess.run(
        ["bash", "-c", f'fidsplat() {{ {FIDSPLAT} "$@"; }}; {text}'],
        cwd=folder,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
    )
    return done.returncode, done.stdout, done.stderr.strip()


def test_a_zeroed_buffer_that_grows_is_large_enough_and_zeroed():
    backend = fs.Renderer("opencl").backend
    workspace, queue = backend.pool, backend.queue
    for size in (16, 4096, 64):
        buffer = workspace.zeroed("a test's", size, queue)
        held = np.ones(buffer.size // 4, np.uint32)
        cl.enqueue_copy(queue, held, buffer)
        assert buffer.size >= size
        assert not held.any()


@pytest.mark.parametrize(
    ("line", "status", "says"),
    [
        ("fidsplat --version > /dev/full", 1, NO_ROOM),
        ("fidsplat marker --help > /dev/full", 1, NO_ROOM),
        ("fidsplat marker nothing 2> /dev/full", 2, ""),
        ("fidsplat --version >&-", 0, ""),
    ],
)
def test_output_that_goes_nowhere(line, status, says, tmp_path):
    actual, out, err = shell(line, tmp_path)
    assert (actual, err) == (status, says)
    assert out == ""


def test_no_file_takes_the_place_of_a_closed_stream(tmp_path):
    """Printed text is not written into the output file."""
    words = "marker aruco:4x4_50:7 --mixture fitted"
    assert shell(f"fidsplat {words} -o whole.ply", tmp_path)[0] == 0
    status, _, err = shell(f"fidsplat {words} -o closed.ply <&- >&-", tmp_path)
    assert (status, err) == (0, "")
    assert (tmp_path / "closed.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


SHORT = """
import resource
import fidsplat as fs
pool = fs.Renderer("opencl:pocl").backend.pool
held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + 2**28, resource.getrlimit(resource.RLIMIT_AS)[1]))
try:
    buffers = [pool.allocate("a buffer", 2**26) for _ in range(9)]
except fs.DeviceError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_memory_that_runs_out_is_an_error_of_the_device(tmp_path):
    """PoCL takes a buffer's memory at its first use unless an option disables it, and crashes there."""
    status, out, err = shell(f"{sys.executable} -c '{SHORT}'", tmp_path)
    assert (status, err) == (0, "")
    assert out.startswith("no memory for a buffer (64 MiB): ")
