"""Files appear whole or not at all."""

import os

import numpy as np
import pytest

from fidsplat.errors import InputError
from fidsplat.files import atomic_write, writable_folder
from fidsplat.npy import load_npy
from fidsplat.train.read import load_dataset


def test_a_file_takes_the_place_of_the_old_one_only_when_it_is_whole(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def write_half():
        with atomic_write(path) as stream:
            stream.write(b"half")
            raise KeyError

    with pytest.raises(KeyError):
        write_half()
    assert path.read_bytes() == b"old"
    with atomic_write(path) as stream:
        stream.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_permissions_are_those_of_any_new_file(tmp_path):
    with atomic_write(tmp_path / "a") as stream:
        stream.write(b"x")
    (tmp_path / "b").write_bytes(b"x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_folders_are_made_and_proved(tmp_path):
    folder = writable_folder(tmp_path / "a" / "b")
    assert folder.is_dir()
    assert list(folder.iterdir()) == []
    (tmp_path / "file").write_bytes(b"")
    for bad in (tmp_path / "file", tmp_path / "file" / "below", "/proc/nowhere"):
        with pytest.raises(InputError, match="another output folder"):
            writable_folder(bad)


def test_a_folder_that_is_missing_or_full_is_an_input_error(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="cannot write"), atomic_write(tmp_path / "none" / "a"):
        pass

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"), atomic_write(tmp_path / "a") as stream:
        stream.write(b"x")
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_ordinary_file_is_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="not an ordinary file"), atomic_write(pipe):
        pass
    assert pipe.is_fifo()


def test_tables_in_a_hundred_thousand_tables_are_no_data_set(tmp_path):
    (tmp_path / "transforms.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="nests too deeply"):
        load_dataset(tmp_path)


def test_a_damaged_header_is_a_damaged_array(tmp_path):
    """Whatever NumPy makes of it: its Python may end within a bracket."""
    np.save(tmp_path / "a.npy", np.zeros(3))
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole.replace(b"(3,)", b"(3, "))
    with pytest.raises(ValueError, match="header"):
        load_npy(tmp_path / "a.npy")
