"""Out-of-core builds of stores: interrupted, on a full disk, concurrent."""

import os
import re
import time
from pathlib import Path
from threading import Lock

import numpy as np
import pytest
from full_disk import small_files
from small_stores import COUNT, NOTED, SMALL, WINDOW, contents, store_fixtures

import fidsplat as fs
from fidsplat.store import build, build_plan

cut, files, store = store_fixtures()


class Stopped(Exception):
    pass


STOPS = [("reading splats", NOTED + 1), ("sorting", 3), ("level of detail 1", 5), ("level of detail 2", 2)]


@pytest.mark.parametrize(("words", "after"), STOPS)
def test_an_interrupted_build_resumes(files, store, tmp_path, words, after):
    calls = []

    def stop(what, share):
        calls.extend([what] * (what == words))
        if len(calls) == after:
            raise Stopped

    with pytest.raises(Stopped):
        fs.build_store(files, tmp_path / "both.fss", progress=stop, **SMALL)
    assert not (tmp_path / "both.fss").exists()
    again = []
    fs.build_store(files, tmp_path / "both.fss", progress=lambda what, share: again.append(what), **SMALL)
    assert contents(tmp_path / "both.fss") == contents(store.path)
    assert list(tmp_path.iterdir()) == [tmp_path / "both.fss"]
    left = 2 * COUNT // WINDOW - NOTED if words == "reading splats" else 0
    assert again.count("reading splats") == left


def test_a_killed_build_leaves_no_files(files, store, tmp_path, monkeypatch):
    calls, folder = [], tmp_path / "both.fss"

    def stop(what, share):
        calls.extend([what] * (what == "sorting"))
        if len(calls) == 3:
            raise Stopped

    with pytest.raises(Stopped):
        fs.build_store(files, folder, progress=stop, **SMALL)
    (tmp_path / ".both.fss.part" / "bucket-0000").touch()  # sorted and noted, and not yet removed
    remove = Path.unlink

    def killed(file, missing_ok=False):
        remove(file, missing_ok)
        if file.name in ("nodes", "state.json"):
            raise Stopped

    monkeypatch.setattr(Path, "unlink", killed)
    with pytest.raises(Stopped):
        fs.build_store(files, folder, **SMALL)
    monkeypatch.undo()
    fs.build_store(files, folder, **SMALL)
    # files of a process that was killed while replacing a store
    (tmp_path / ".both.fss.old").mkdir()
    (tmp_path / ".both.fss.old" / "means.npy").touch()
    fs.build_store(files, folder, overwrite=True, **SMALL)
    assert contents(folder) == contents(store.path)
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize("words", ["reading splats", "sorting"])
def test_a_build_restarts_if_files_were_lost(files, store, tmp_path, words):
    calls = []

    def stop(what, share):
        calls.extend([what] * (what == words))
        if len(calls) == NOTED + 1:
            raise Stopped

    with pytest.raises(Stopped):
        fs.build_store(files, tmp_path / "both.fss", progress=stop, **SMALL)
    last = max((tmp_path / ".both.fss.part").glob("bucket-*"), key=lambda file: file.stat().st_size)
    os.truncate(last, last.stat().st_size // 3)
    fs.build_store(files, tmp_path / "both.fss", **SMALL)
    assert contents(tmp_path / "both.fss") == contents(store.path)


def test_chunks_too_large_for_the_memory_are_refused(files, tmp_path, monkeypatch):
    """The suggested chunk size works, and nodes are merged one by one if memory allows only one."""
    under_way, most, lock, original = 0, 0, Lock(), build.merged

    def merged(*given):
        nonlocal under_way, most
        with lock:
            under_way += 1
            most = max(most, under_way)
        time.sleep(0.002)
        try:
            return original(*given)
        finally:
            with lock:
                under_way -= 1

    monkeypatch.setattr(build_plan, "_MERGE_BYTES", (400, 6))
    monkeypatch.setattr(build, "merged", merged)
    with pytest.raises(fs.InputError, match=r"at most .* in 1 MiB, got 500") as refused:
        fs.build_store(files, tmp_path / "both.fss", **SMALL)
    fitting = int(re.findall("at most ([0-9]+) for", str(refused.value))[0])
    fs.build_store(files, tmp_path / "both.fss", **SMALL | {"chunk": fitting})
    assert (64 < fitting < 500, most) == (True, 1)
    fs.build_store(files, tmp_path / "plain.fss", levels=False, **SMALL)


def test_two_builds_of_one_store_at_once(files, store, tmp_path):
    refused = []

    def second(what, share):
        if not refused:
            with pytest.raises(fs.InputError, match="another process is building"):
                fs.build_store(files[1:], tmp_path / "both.fss", **SMALL)
            refused.append(what)

    fs.build_store(files, tmp_path / "both.fss", progress=second, **SMALL)
    assert refused
    assert contents(tmp_path / "both.fss") == contents(store.path)


def test_an_instanced_store_contains_no_files_of_an_interrupted_build(files, tmp_path):
    def stop(what, share):
        raise Stopped

    flat = fs.build_store(files[1:], tmp_path / "one.fss", **SMALL)
    with pytest.raises(Stopped):
        fs.build_store(files, tmp_path / "both.fss", progress=stop, **SMALL)
    fs.place_store(flat, tmp_path / "both.fss", [np.eye(4)])
    assert set(contents(tmp_path / "both.fss")) == {"store.json", "places.npy"}


def test_a_build_restarts_for_other_inputs(files, store, tmp_path):
    def stop(what, share):
        if what == "sorting":
            raise Stopped

    with pytest.raises(Stopped):
        fs.build_store(files[:1], tmp_path / "both.fss", progress=stop, **SMALL)
    fs.build_store(files, tmp_path / "both.fss", **SMALL)
    assert contents(tmp_path / "both.fss") == contents(store.path)


def test_a_full_disk_is_reported_and_the_build_resumes(files, store, tmp_path):
    with (
        small_files(100_000),
        pytest.raises(fs.InputError, match="free some space, then run the same command"),
    ):
        fs.build_store(files, tmp_path / "both.fss", **SMALL)
    assert not (tmp_path / "both.fss").exists()
    fs.build_store(files, tmp_path / "both.fss", **SMALL)
    assert contents(tmp_path / "both.fss") == contents(store.path)


def test_too_little_disk_space_is_reported_first(files, tmp_path, monkeypatch):
    monkeypatch.setattr(build.shutil, "disk_usage", lambda folder: type("", (), {"free": 10_000})())
    with pytest.raises(fs.InputError, match="free some space, or build elsewhere"):
        fs.build_store(files, tmp_path / "both.fss", **SMALL)
