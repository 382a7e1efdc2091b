"""Sources of stores: files with invalid splats, truncated files, empty files."""

import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes.random_clouds import random_splats


def test_a_file_with_a_wrong_count_is_refused(tmp_path):
    fs.save_ply(random_splats(9000, 1), tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    liar = tmp_path / "liar.ply"
    liar.write_bytes(content.replace(b"element vertex 9000", b"element vertex 9001"))
    with pytest.raises(fs.InputError, match="truncated"):
        fs.build_store([liar], tmp_path / "liar.fss")
    assert set(tmp_path.iterdir()) == {liar, tmp_path / "a.ply"}


def test_invalid_splats_are_omitted_and_counted(tmp_path):
    cloud = random_splats(3000, 5)
    fs.save_ply(cloud, tmp_path / "a.ply")
    content = bytearray((tmp_path / "a.ply").read_bytes())
    row = (len(content) - content.index(b"end_header\n") - 11) // 3000
    content[-row : -row + 4] = np.float32(math.nan).tobytes()
    (tmp_path / "a.ply").write_bytes(content)
    store = fs.Store(fs.build_store([tmp_path / "a.ply"], tmp_path / "a.fss"))
    assert len(store) == 2999
    assert store.header.dropped == {"means not finite": 1}
    assert store.ellipsoids == "none"
    assert "thickness" not in store.header.columns


def test_an_empty_file_makes_an_empty_store(tmp_path):
    fs.save_ply(fs.SplatCloud.empty(), tmp_path / "none.ply")
    store = fs.Store(fs.build_store([tmp_path / "none.ply"], tmp_path / "none.fss"))
    assert len(store) == 0
    assert len(store.cloud()) == 0
    assert store.verify() == []
    assert "splats" in store.summary()
