"""Cache folders of drivers are replaced if they cannot be written."""

import os
import subprocess
import sys
import warnings
from collections import namedtuple
from pathlib import Path

import pytest

from fidsplat.backends import caches

NAMES = ("POCL_CACHE_DIR", "XDG_CACHE_HOME")


@pytest.fixture
def ensure(monkeypatch, tmp_path):
    """Calls `ensure_caches` with some folders, and returns its warnings."""
    results = []

    def call(**places) -> str:
        for name in NAMES:
            monkeypatch.setenv(name, str(places.get(name, tmp_path / name)))
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            caches.ensure_caches.__wrapped__()
        results.extend(Path(os.environ[name]) for name in places)
        return " ".join(str(one.message) for one in heard)

    yield call
    for folder in results:
        if "fidsplat-cache-" in str(folder):
            caches._remove(folder.parent, os.getpid())
            assert not folder.parent.exists()


def test_what_can_be_written_stays(ensure, tmp_path):
    assert ensure() == ""
    assert [os.environ[name] for name in NAMES] == [str(tmp_path / name) for name in NAMES]


@pytest.mark.parametrize("name", NAMES)
def test_a_cache_that_cannot_be_written_is_replaced(ensure, name):
    warning = ensure(**{name: "/dev/null/nowhere"})
    assert warning.startswith(
        "kernels are compiled again in this run: cannot write into the folder /dev/null/nowhere"
    )
    assert warning.endswith(f"; set {name} to a folder of your own with free space")
    assert Path(os.environ[name]).parent.name.startswith("fidsplat-cache-")


def test_a_full_disk(ensure, monkeypatch):
    monkeypatch.setattr(caches.shutil, "disk_usage", lambda _: namedtuple("Usage", "free")(2**20))
    warning = ensure(POCL_CACHE_DIR="/tmp", XDG_CACHE_HOME="/tmp")
    assert "/tmp has only 1 MB of free space" in warning
    assert warning.endswith("set POCL_CACHE_DIR and XDG_CACHE_HOME to a folder of your own with free space")


def test_folders_of_others_hold_no_kernels(ensure, tmp_path, monkeypatch):
    tmp_path.chmod(0o777)
    warning = ensure(POCL_CACHE_DIR=tmp_path)
    assert f"{tmp_path} can be written by every user" in warning
    tmp_path.chmod(0o755)
    monkeypatch.setattr(caches.os, "geteuid", lambda: os.getuid() + 1)
    assert f"{tmp_path} belongs to another user" in ensure(POCL_CACHE_DIR=tmp_path)


def test_without_home_pocl_does_not_use_the_folder_for_temporary_files(ensure, monkeypatch, tmp_path):
    """HOME is not set, and the user has a home folder."""
    for name in (*NAMES, "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(caches.os.path, "expanduser", lambda text: str(tmp_path))
    caches.ensure_caches.__wrapped__()
    assert os.environ["POCL_CACHE_DIR"] == str(tmp_path / ".cache" / "pocl" / "kcache")
    monkeypatch.delenv("POCL_CACHE_DIR")


def test_a_user_without_a_home(ensure, monkeypatch, tmp_path):
    monkeypatch.setattr(caches.os.path, "expanduser", lambda text: text)
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    with pytest.warns(UserWarning, match="this user has no home folder; set XDG_CACHE_HOME"):
        caches.ensure_caches.__wrapped__()
    caches._remove(Path(os.environ["XDG_CACHE_HOME"]).parent, os.getpid())


def test_a_frame_is_rendered_nevertheless(tmp_path):
    """And what it took is removed."""
    draw = (
        "import fidsplat as fs, tempfile; from fidsplat.scenes.random_clouds import random_splats;"
        "camera = fs.Camera.pinhole(8, 8, 8, 8, 4, 4);"
        "print(fs.Renderer('opencl:pocl').render(random_splats(3, 0), camera)['rgb'].shape)"
    )
    places = dict.fromkeys(NAMES, "/dev/null/nowhere") | {"TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", draw], env=os.environ | places, capture_output=True, text=True
    )
    if "no OpenCL" in done.stderr:
        pytest.skip("there is no PoCL here")
    assert done.stdout == "(8, 8, 3)\n", done.stderr
    assert "kernels are compiled again" in done.stderr
    assert list(tmp_path.glob("fidsplat-cache-*")) == []
