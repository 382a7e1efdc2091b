"""Stores of damaged splats with valid checksums: reported, and harmless when they are rendered."""

import json
import re
import shutil
import warnings
import zlib

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.store import build_plan
from fidsplat.store.layout import NPY_HEADER, checksum, header_crc, npy_header, row_bytes, shapes_of
from fidsplat.util import limits

COUNT, PLANAR = 600, 6
VALUES = {
    "means": (np.nan, np.inf, -np.inf, 3e38, -1e30),
    "quats": (np.nan, np.inf, 0.0, 1e-30, 1e30),
    "scales": (np.nan, np.inf, -1.0, 0.0, 1e30, 1e-38),
    "opacities": (np.nan, np.inf, -1.0, 2.0, 1e30),
    "thickness": (np.nan, np.inf, -1.0, 1e30),
    "sh": (np.nan, np.inf, -np.inf, 1e30, -1e30),
    "labels": (-(2**31), 2**31 - 1),
    "coplanar_groups": (-(2**31), -5, 10**6, 2**31 - 1),
}
CAMERA = fs.Camera.look_at(32, 24, 1.0, position=(0.3, 0.2, -6.0), target=(0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Chunks of 100 splats with levels of detail, two coplanar groups, disks and 3D Gaussians."""
    cloud = random_splats(COUNT, 3, sh_degree=1)
    third = cloud.scales.max(axis=1) * np.where(np.arange(COUNT) % 2, 0.4, 0.0).astype(np.float32)
    third[:PLANAR] = 0.0
    scales = np.column_stack([cloud.scales, third])
    cloud = fs.SplatCloud(cloud.means, cloud.quats, scales, cloud.opacities, sh=cloud.sh, labels=3)
    cloud = cloud.with_coplanar_groups(np.where(np.arange(COUNT) < PLANAR, np.arange(COUNT) // 3, -1))
    path = tmp_path_factory.mktemp("values")
    fs.save_ply(cloud, path / "a.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_plan, "_MIN_MEMORY", 0)
        patch.setattr(build_plan, "_MERGE_BYTES", (0, 0.01))
        return fs.build_store([path / "a.ply"], path / "a.fss", chunk=100, memory=1 << 20)


def crafted(folder, target, column, rows, value):
    """A copy of a store with a value in some rows of a column, and with checksums that fit."""
    shutil.copytree(folder, target)
    header, nodes = json.loads((target / "store.json").read_text()), np.load(target / "nodes.npy")
    columns = {name: np.load(target / f"{name}.npy") for name in header["columns"]}
    columns[column][rows] = value
    file = target / f"{column}.npy"
    file.write_bytes(file.read_bytes()[:NPY_HEADER] + columns[column].tobytes())
    for node in nodes:
        part = slice(node["first"], node["first"] + node["count"])
        node["crc"] = checksum({name: array[part] for name, array in columns.items()})
    np.save(target / "nodes.npy", nodes)
    header["nodes_crc"] = zlib.crc32(nodes.tobytes())
    (target / "store.json").write_text(json.dumps(header | {"crc": header_crc(header)}))
    return target


@pytest.mark.sweep
@pytest.mark.parametrize("column", list(VALUES))
def test_damaged_splats_are_harmless_when_rendered(folder, tmp_path, monkeypatch, renderer, column):
    monkeypatch.setattr(
        fs.Store, "cell_sizes", lambda store, quality: (0.0, *[1e9 * quality.detail_error] * store.levels)
    )
    store = fs.Store(folder)
    assert store.levels
    free = np.arange(0, store.header.pinned, 7)
    for k, value in enumerate(VALUES[column]):
        for rows in (free, slice(0, store.header.pinned)):
            path = crafted(folder, tmp_path / f"{k}-{type(rows).__name__}.fss", column, rows, value)
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                scene = fs.Scene([], CAMERA, stores=(fs.Store(path),))
                for quality in (fs.Quality(), fs.Quality(detail_error=0.3)):
                    frame = renderer.render(scene, outputs=("rgb", "depth", "alpha"), quality=quality)
                    alpha = frame["alpha"]
                    assert np.isfinite(alpha).all(), (column, value)
                    assert (alpha >= 0).all(), (column, value)
                    assert (alpha <= 1 + 1e-6).all(), (column, value)
                    if column != "sh":
                        assert np.isfinite(frame["rgb"]).all(), (column, value)


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("means", np.nan, "means not finite: 1"),
        ("quats", 0.0, "zero quaternion: 1"),
        ("scales", -1.0, "scale not above 0: 1"),
        ("opacities", 1.5, r"opacity outside \[0, 1\]: 1"),
        ("thickness", -1.0, "thickness below 0: 1"),
        ("sh", np.inf, "sh not finite: 1"),
    ],
)
def test_damaged_splats_are_reported_with_their_chunk(folder, tmp_path, column, value, words):
    assert fs.Store(folder).verify() == []
    (wrong,) = fs.Store(crafted(folder, tmp_path / "a.fss", column, 130, value)).verify()
    assert wrong.startswith("chunk 1, rows 99 to ")
    assert re.search(words, wrong)


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("means", np.inf, "must be valid, got means not finite: 1"),
        ("quats", 0.0, "must be valid, got zero quaternion: 1"),
        ("scales", np.inf, "must be valid, got scales not finite: 1"),
        ("coplanar_groups", -3, "coplanar group ids of .* must be at least 0"),
    ],
)
def test_damaged_coplanar_splats_are_refused(folder, tmp_path, column, value, words):
    with pytest.raises(fs.InputError, match=words):
        fs.Store(crafted(folder, tmp_path / "a.fss", column, COUNT - 1, value))


@pytest.mark.parametrize("value", [10**6, 2**31 - 1])
def test_large_ids_of_coplanar_groups_are_rendered(folder, tmp_path, renderer, value):
    def alpha(path):
        scene = fs.Scene([], CAMERA, stores=(fs.Store(path),))
        return renderer.render(scene, outputs=("alpha",))["alpha"]

    path = crafted(folder, tmp_path / "a.fss", "coplanar_groups", COUNT - 1, value)
    np.testing.assert_allclose(alpha(path), alpha(folder), atol=1e-5)


def header_of(folder, **said):
    """Change a store's header, with its checksum."""
    header = json.loads((folder / "store.json").read_text()) | said
    header.pop("crc")
    (folder / "store.json").write_text(json.dumps(header | {"crc": header_crc(header)}))


def test_sparse_columns_are_refused(folder, tmp_path, monkeypatch):
    """A few kilobytes on the disk that declare 4 million splats."""
    count = 2**22
    shutil.copytree(folder, tmp_path / "a.fss")
    path = tmp_path / "a.fss"
    nodes = np.load(path / "nodes.npy")[:1]
    nodes["count"], nodes["parent"] = count, -1
    np.save(path / "nodes.npy", nodes)
    columns = json.loads((path / "store.json").read_text())["columns"]
    for name, kind in columns.items():
        shape = (count, *shapes_of(1)[name])
        with (path / f"{name}.npy").open("r+b") as stream:
            stream.write(npy_header(kind, shape))
            stream.truncate(NPY_HEADER + row_bytes(kind, shape))
    header = {"nodes_crc": zlib.crc32(nodes.tobytes()), "splats": count, "rows": count, "pinned": count}
    header_of(path, **header, chunk=count)
    monkeypatch.setattr(limits, "FLOOR", 2**23)
    with pytest.raises(fs.InputError, match=r"must have at most 8 MiB, as it has .*FIDSPLAT_INPUT_LIMIT="):
        fs.Store(path)
    header_of(path, chunk=count + 1)
    with pytest.raises(fs.InputError, match="a count is out of range"):
        fs.Store(path)


@pytest.mark.parametrize("name", ["x" * 300, "x/" * 3000, "a\0b", "\ud800"])
def test_impossible_paths_of_the_instanced_store_are_refused(folder, tmp_path, name):
    shutil.copytree(folder, tmp_path / "a.fss")
    header_of(tmp_path / "a.fss", store=name, places_crc=0)
    with pytest.raises(fs.InputError):
        fs.Store(tmp_path / "a.fss")


def test_group_ids_beyond_int32_together_are_refused(folder, tmp_path):
    last = crafted(folder, tmp_path / "a.fss", "coplanar_groups", COUNT - 1, 2**31 - 1)
    stores = (fs.Store(last), fs.Store(folder))
    with pytest.raises(fs.InputError, match="must have fewer than 2\\^31 coplanar groups"):
        fs.Renderer("reference").render(fs.Scene([], CAMERA, stores=stores))
    ids = random_splats(3, 0).with_coplanar_groups(2**31 - 1)
    with pytest.raises(fs.InputError, match="number the groups of each cloud from 0"):
        fs.SplatCloud.concatenate([ids, ids])
    joined = fs.SplatCloud.concatenate([ids, random_splats(3, 0)])
    np.testing.assert_array_equal(joined.coplanar_groups, [2**31 - 1] * 3 + [-1] * 3)
    fs.save_ply(ids, tmp_path / "a.ply")
    with pytest.raises(fs.InputError, match="number the groups of each cloud from 0"):
        fs.build_store([tmp_path / "a.ply"] * 2, tmp_path / "b.fss")


@pytest.mark.parametrize("edge", [3e38, 1e19, 0.0])
def test_false_boxes_are_rendered_without_a_warning(folder, tmp_path, edge):
    """Boxes of valid checksums that contain no splat, or everything."""
    path = tmp_path / "a.fss"
    shutil.copytree(folder, path)
    nodes = np.load(path / "nodes.npy")
    for name, sign in (("far_low", -1), ("low", -1), ("high", 1), ("far_high", 1)):
        nodes[name] = sign * edge
    nodes["reach"] = edge
    np.save(path / "nodes.npy", nodes)
    header_of(path, nodes_crc=zlib.crc32(nodes.tobytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for camera in (CAMERA, fs.Camera.fisheye(32, 24, 2.5), fs.Camera.equirectangular(32, 16)):
            fs.Renderer("reference").render(
                fs.Scene([], camera, stores=(fs.Store(path),)), outputs=("alpha",)
            )


def test_an_error_beyond_floats_is_a_damaged_file(folder, tmp_path):
    path = tmp_path / "a.fss"
    shutil.copytree(folder, path)
    one = {"lowpass": "screen", "level": 0, "sizes": [10**400], "errors": [0.1], "views": 1}
    header = {"identity": fs.Store(path).identity, "details": [one | {"device": "", "date": ""}]}
    (path / "detail.json").write_text(json.dumps(header | {"crc": header_crc(header)}))
    with pytest.raises(fs.InputError, match=r"detail\.json is damaged"):
        _ = fs.Store(path).detail_errors
