"""Streamed SOG: lod-meta.json read as splats and as a store with its levels, and written from a store."""

import json

import numpy as np
import pytest
import splat_transform
from test_formats import some

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.formats.sog_streamed import read_streamed
from fidsplat.store.streamed import export_streamed


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A store of three levels or more and its streamed SOG."""
    folder = tmp_path_factory.mktemp("streamed")
    source = folder / "a.ply"
    fs.save_splats(some(count=3000, degree=1), source)
    store = fs.Store(fs.build_store([source], folder / "a.fss", chunk=64))
    export_streamed(store, folder / "lod-meta.json")
    return store, folder / "lod-meta.json"


def test_a_store_as_streamed_sog_and_back(exported, tmp_path):
    store, path = exported
    meta = json.loads(path.read_text())
    assert meta["lodLevels"] == store.levels + 1 or meta["lodLevels"] == store.levels
    assert meta["counts"][0] == len(store) == len(fs.load_splats(path))
    again = fs.Store(fs.build_store(path, tmp_path / "b.fss"))
    assert again.verify() == []
    assert len(again) == len(store)
    levels = lambda each: np.bincount(each.nodes["level"], each.nodes["count"])  # noqa: E731
    np.testing.assert_array_equal(levels(again), levels(store))
    assert (np.diff([again.nodes["size"][again.nodes["level"] == k].max() for k in range(3)]) > 0).all()
    ours, other = store.cloud().means, again.cloud().means
    np.testing.assert_allclose(ours, other, rtol=2e-3, atol=3e-4)


def test_convert_writes_streamed_sog_of_a_store(exported, tmp_path, capsys):
    store, _ = exported
    assert main(["convert", str(store.path), str(tmp_path / "lod-meta.json")]) == 0
    assert "3,000 splats as streamed SOG" in capsys.readouterr().out
    with pytest.raises(fs.InputError, match="must be written from a store"):
        fs.save_splats(some(), tmp_path / "lod-meta.json")


@splat_transform.NEEDED
def test_streamed_sog_of_splat_transform(exported, tmp_path):
    _, path = exported
    fine, coarse = some(count=900, degree=1), some(count=200, degree=1)
    fs.save_splats(fine, tmp_path / "fine.ply")
    fs.save_splats(coarse, tmp_path / "coarse.ply")
    (tmp_path / "theirs").mkdir()
    theirs = tmp_path / "theirs/lod-meta.json"
    splat_transform.transform(tmp_path / "fine.ply", "-l", 0, tmp_path / "coarse.ply", "-l", 1, theirs)
    store = fs.Store(fs.build_store(theirs, tmp_path / "theirs.fss"))
    assert store.verify() == []
    assert store.nodes["count"][store.nodes["level"] == 0].sum() == 900
    assert store.nodes["count"][store.nodes["level"] == 1].sum() == 200
    np.testing.assert_allclose(
        np.sort(store.cloud().means, axis=0), np.sort(fine.means, axis=0), rtol=2e-3, atol=3e-4
    )
    splat_transform.converted(path.parent / "1_0/meta.json", tmp_path / "level.ply")
    level = read_streamed(path).load(1)
    assert len(fs.load_splats(tmp_path / "level.ply")) == sum(len(cloud) for _, cloud in level)
    if splat_transform.version() >= 3:  # earlier versions do not read streamed SOG
        splat_transform.converted(path, tmp_path / "all.ply")
        np.testing.assert_array_equal(fs.load_splats(tmp_path / "all.ply").means, fs.load_splats(path).means)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": 2}, "the version of streamed SOG must be 1, got 2; convert it with splat-transform"),
        ({"lodLevels": 10**9}, "lodLevels must be 1 to 64"),
        ({"filenames": ["../../a/meta.json"]}, "must be in its folder"),
        ({"filenames": []}, "a leaf must refer to levels"),
        ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 10**15}}}}, "half|at most|must end by"),
        ({"tree": {"lods": {"0": {"file": 0, "offset": 10**6, "count": 3}}}}, "must end by splat"),
        ({"tree": {}}, "must have splats of level 0"),
        ({"tree": {"children": [3]}}, "damaged"),
        ({"environment": "1_0/meta.json"}, "must have no environment for a store"),
    ],
)
def test_damaged_streamed_sog(exported, tmp_path, changes, words):
    _, path = exported
    meta = json.loads(path.read_text()) | changes
    bad = path.with_name("bad") / "lod-meta.json"
    bad.parent.mkdir(exist_ok=True)
    for folder in path.parent.glob("?_0"):
        link = bad.parent / folder.name
        if not link.exists():
            link.mkdir()
            for file in folder.iterdir():
                (link / file.name).write_bytes(file.read_bytes())
    bad.write_text(json.dumps(meta))
    with pytest.raises(fs.InputError, match=words):
        fs.build_store(bad, tmp_path / "b.fss")
