"""What is half written in PoCL's kernel cache is found and removed before PoCL trips over it."""

import os
import shutil
import subprocess
import sys
import time

import pytest

from fidsplat.backends.caches import pocl_folder
from fidsplat.backends.opencl.pocl_workarounds.kernel_cache import is_whole, remove_broken

DRAW = """
import numpy as np, fidsplat as fs
one = np.ones((1, 4), np.float32)
cloud = fs.SplatCloud([[0, 0, 2]], one, one[:, :2] * 0.3, one[:, 0], colors=one[:, :3])
print(fs.Renderer("opencl:pocl").render(cloud, fs.Camera.pinhole(8, 8, 8, 8, 4, 4))["rgb"].sum())
"""
DAMAGES = {
    "cut off": lambda content: content[: len(content) // 2],
    "a byte short": lambda content: content[:-1],
    "noise": lambda content: bytes(7 * k % 251 for k in range(len(content))),
    "empty": lambda content: b"",
}


@pytest.fixture(scope="module")
def full_cache(tmp_path_factory):
    """The cache that a process leaves which draws one picture, and what it printed."""
    folder = tmp_path_factory.mktemp("pocl")
    done = draw(folder)
    if "opencl:pocl" in done.stderr and done.returncode:
        pytest.skip("there is no PoCL here")
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def draw(folder):
    return subprocess.run(
        [sys.executable, "-c", DRAW],
        env=os.environ | {"POCL_CACHE_DIR": str(folder), "XDG_CACHE_HOME": str(folder / "other")},
        capture_output=True,
        text=True,
    )


def compiled(folder):
    return sorted(path for path in folder.rglob("*") if path.suffix in (".so", ".bc"))


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_found(full_cache, tmp_path, damage):
    files = compiled(full_cache[0])
    assert {path.suffix for path in files} == {".so", ".bc"}
    assert all(map(is_whole, files))
    for path in files:
        broken = tmp_path / f"broken{path.suffix}"
        broken.write_bytes(DAMAGES[damage](path.read_bytes()))
        assert not is_whole(broken), path


def test_a_damaged_cache_is_compiled_again(full_cache, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    for path, damage in zip(compiled(folder), [*DAMAGES.values()] * 9, strict=False):
        path.write_bytes(damage(path.read_bytes()))
    done = draw(folder)
    assert (done.returncode, done.stdout) == (0, full_cache[1]), done.stderr
    assert all(map(is_whole, compiled(folder)))


def test_a_program_without_kernels_is_built_again(monkeypatch):
    """As PoCL gives it where another process has not finished writing."""
    pytest.importorskip("pyopencl")
    import fidsplat as fs
    from fidsplat.backends.opencl import program

    renderer, builds, build = fs.Renderer("opencl:pocl"), [], program.build

    class Empty:
        def all_kernels(self):
            return []

    def first_in_vain(workspace, text, *options):
        builds.append(options)
        attempt = int(options[0][-1]) if options else 0
        return Empty() if attempt < failures else build(workspace, text, *options)

    monkeypatch.setattr(program, "build", first_in_vain)
    cloud = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[0.3, 0.3]], [0.5], colors=[[1, 1, 1]])
    camera = fs.Camera.pinhole(8, 8, 8, 8, 4, 4)
    failures = 3
    with pytest.raises(fs.DeviceError, match="cache of compiled kernels"):
        renderer.render(cloud, camera)
    builds.clear()
    failures = 1
    assert renderer.render(cloud, camera)["rgb"].sum() > 0
    assert list(dict.fromkeys(builds)) == [(), ("-DATTEMPT_1",)]


def test_a_damaged_cache_of_pyopencl_is_done_without(full_cache, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    (database,) = (folder / "other").rglob("*.sqlite")
    database.write_bytes(DAMAGES["noise"](database.read_bytes()))
    done = draw(folder)
    assert (done.returncode, done.stdout) == (0, full_cache[1]), done.stderr


def test_what_is_whole_stays(full_cache, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    before = compiled(folder)
    assert remove_broken(folder) == 0
    assert compiled(folder) == before
    assert remove_broken(tmp_path / "nowhere") == 0


def test_a_clock_that_was_put_back_hides_nothing(full_cache, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    remove_broken(folder)
    later = time.time() + 3600
    os.utime(folder / "fidsplat-checked", (later, later))
    compiled(folder)[0].write_bytes(b"")
    assert remove_broken(folder) == 1


def test_the_cache_is_where_pocl_looks(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("POCL_CACHE_DIR", raising=False)
    assert pocl_folder() == tmp_path / "pocl" / "kcache"
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "mine"))
    assert pocl_folder() == tmp_path / "mine"


def test_what_another_process_is_about_to_finish_is_left_alone(tmp_path):
    unfinished, broken = tmp_path / "tempfile_ab12cd.so", tmp_path / "blend.so"
    for file in (unfinished, broken):
        file.write_bytes(b"")
    assert remove_broken(tmp_path) == 1
    assert unfinished.exists()
    assert not broken.exists()
