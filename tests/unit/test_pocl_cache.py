"""Damaged files in kernel caches are removed before the driver loads them."""

import os
import shutil
import subprocess
import sys

import pytest

from fidsplat.backends.caches import pocl_folder
from fidsplat.backends.checked_cache import record_new, remove_damaged
from fidsplat.backends.opencl.pocl_workarounds.kernel_cache import is_complete, is_loaded

DRAW = """
import numpy as np, fidsplat as fs
one = np.ones((1, 4), np.float32)
cloud = fs.SplatCloud([[0, 0, 2]], one, one[:, :2] * 0.3, one[:, 0], colors=one[:, :3])
print(fs.Renderer("DEVICE").render(cloud, fs.Camera.pinhole(8, 8, 8, 8, 4, 4))["rgb"].sum())
"""
DAMAGES = {
    "cut off": lambda content: content[: len(content) // 2],
    "a byte short": lambda content: content[:-1],
    "noise": lambda content: bytes(7 * k % 251 for k in range(len(content))),
    "empty": lambda content: b"",
}


@pytest.fixture(scope="module")
def full_cache(tmp_path_factory):
    """The cache of a process that renders one image, and its output."""
    folder = tmp_path_factory.mktemp("pocl")
    done = draw(folder)
    if "opencl:pocl" in done.stderr and done.returncode:
        pytest.skip("there is no PoCL here")
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def draw(folder, device="opencl:pocl"):
    return subprocess.run(
        [sys.executable, "-c", DRAW.replace("DEVICE", device)],
        env=os.environ | {"POCL_CACHE_DIR": str(folder), "XDG_CACHE_HOME": str(folder / "other")},
        capture_output=True,
        text=True,
        timeout=120,
    )


def compiled(folder):
    return sorted(path for path in folder.rglob("*") if path.suffix in (".so", ".bc"))


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_found(full_cache, tmp_path, damage):
    files = compiled(full_cache[0])
    assert {path.suffix for path in files} == {".so", ".bc"}
    assert all(map(is_complete, files))
    for path in files:
        broken = tmp_path / f"broken{path.suffix}"
        broken.write_bytes(DAMAGES[damage](path.read_bytes()))
        assert not is_complete(broken), path


def test_a_damaged_cache_is_compiled_again(full_cache, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    for path, damage in zip(compiled(folder), [*DAMAGES.values()] * 9, strict=False):
        path.write_bytes(damage(path.read_bytes()))
    done = draw(folder)
    assert (done.returncode, done.stdout) == (0, full_cache[1]), done.stderr
    assert all(map(is_complete, compiled(folder)))


def test_a_program_without_kernels_is_built_again(monkeypatch):
    """The error of PoCL for a cache entry that another process has not finished."""
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


def flip_a_bit(path):
    """In the middle, with the times of the file as they were."""
    content, state = bytearray(path.read_bytes()), path.stat()
    content[len(content) // 2] ^= 16
    path.write_bytes(content)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def put_a_folder(path):
    path.unlink()
    path.mkdir()


def put_a_fifo(path):
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("damage", [flip_a_bit, put_a_folder, put_a_fifo])
def test_what_a_checksum_or_the_kind_of_file_shows_is_compiled_again(full_cache, tmp_path, damage):
    """Structure does not show these. The copy has other times, so that checksums decide."""
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    files = compiled(folder)
    names = [path.relative_to(folder) for path in files]
    assert remove_damaged(folder, is_loaded, is_complete) == 0
    for path in files:
        damage(path)
    if damage is not flip_a_bit:
        damage(next(folder.rglob("last_accessed")))
    done = draw(folder)
    assert (done.returncode, done.stdout) == (0, full_cache[1]), done.stderr
    assert [path.relative_to(folder) for path in compiled(folder) if path.is_file()] == names


@pytest.mark.exhaustive
def test_kernels_of_warp_are_checked_too(tmp_path):
    pytest.importorskip("warp")
    folder = tmp_path / "cache"
    first = draw(folder, "warp:cpu")
    objects = sorted(folder.rglob("*.o"))
    assert objects
    for path in objects:
        flip_a_bit(path)
    put_a_folder(next(folder.rglob("*.meta")))
    done = draw(folder, "warp:cpu")
    assert (done.returncode, done.stdout) == (0, first.stdout), done.stderr
    assert all(path.is_file() for path in folder.rglob("*.meta"))


def flip_an_entry(path):
    """A digit of a checksum, in JSON that stays valid."""
    text = path.read_text()
    at = text.index("[") + 1
    path.write_text(text[:at] + ("1" if text[at] == "2" else "2") + text[at + 1 :])


@pytest.mark.parametrize(
    "damage",
    [
        put_a_fifo,
        put_a_folder,
        flip_an_entry,
        lambda path: path.write_text("[1"),
        lambda path: path.write_text("{"),
    ],
)
def test_files_of_a_damaged_record_of_checksums_are_removed(full_cache, tmp_path, damage):
    """Whether their bits are flipped too cannot be seen."""
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    count = sum(is_loaded(path.name) for path in folder.rglob("*"))
    damage(folder / "fidsplat-checksums.json")
    assert remove_damaged(folder, is_loaded, is_complete) == count
    assert compiled(folder) == []
    assert (folder / "fidsplat-checksums.json").read_text().startswith('{"crc"')
    assert remove_damaged(folder, is_loaded, is_complete) == 0


def test_new_files_get_a_checksum_when_the_process_ends(tmp_path):
    program = tmp_path / "program.bc"
    program.write_bytes(b"new")
    record_new(tmp_path, is_loaded)
    flip_a_bit(program)
    assert remove_damaged(tmp_path, is_loaded, lambda _: True) == 1
    assert not program.exists()


def test_what_is_complete_stays(full_cache, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(full_cache[0], folder)
    before = compiled(folder)
    assert remove_damaged(folder, is_loaded, is_complete) == 0
    assert compiled(folder) == before
    assert remove_damaged(tmp_path / "nowhere", is_loaded, is_complete) == 0


def test_the_cache_is_where_pocl_looks(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("POCL_CACHE_DIR", raising=False)
    assert pocl_folder() == tmp_path / "pocl" / "kcache"
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "mine"))
    assert pocl_folder() == tmp_path / "mine"


def test_what_another_process_is_about_to_finish_is_unchanged(tmp_path):
    unfinished, broken = tmp_path / "tempfile_ab12cd.so", tmp_path / "blend.so"
    for file in (unfinished, broken):
        file.write_bytes(b"")
    assert remove_damaged(tmp_path, is_loaded, is_complete) == 1
    assert unfinished.exists()
    assert not broken.exists()
