"""Limits of the process that are too low end in one line before a driver is entered."""

import os
import re
import subprocess
import sys

import pytest

import fidsplat as fs

RENDER = "render one.ply -o one.png"
ONE = fs.SplatCloud([[0, 0, 1]], [[1, 0, 0, 0]], [[0.1, 0.1]], [0.9], colors=[[1, 1, 1]])


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
@pytest.mark.parametrize(
    ("limit", "says"),
    [
        ("-v 500000", "the limit on memory must be at least"),
        ("-v 900000", "the limit on memory must leave at least"),
        ("-f 64", "the limit on file size must be at least 16 MiB for compiled kernels, got 64 KiB"),
        ("-n 8", "the limit on open files must be at least 32 for compiled kernels, got 8"),
    ],
)
def test_a_limit_that_is_too_low_is_one_line(tmp_path, limit, says):
    """With empty kernel caches, as PoCL's compiler aborts the process only where it compiles."""
    fs.save_ply(ONE, tmp_path / "one.ply")
    caches = {"POCL_CACHE_DIR": str(tmp_path / "pocl"), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = f"ulimit {limit}; exec {sys.executable} -m fidsplat {RENDER}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, env=os.environ | caches, capture_output=True, text=True
    )
    (line,) = done.stderr.splitlines()
    assert done.returncode in (1, 2)
    assert line.startswith(f"fidsplat: {says}")
    assert f"`ulimit {limit[:2]}" in line
    if limit.startswith("-v"):
        enough = re.search(r"`(ulimit -v \d+)`", line)[1]
        command = f"{enough}; exec {sys.executable} -m fidsplat {RENDER}"
        subprocess.run(["bash", "-c", command], cwd=tmp_path, check=True)
