"""Stores: content, damage, instances."""

import json
import tracemalloc
import zlib

import numpy as np
import pytest
from small_stores import COUNT, SMALL, contents, store_fixtures

import fidsplat as fs
from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.store.layout import FAR, NODE, NPY_HEADER, header_crc
from fidsplat.store.merge import REDUCTION

cut, files, store = store_fixtures()


def sorted_by_position(cloud):
    order = np.lexsort((*cloud.means.T, cloud.opacities))
    arrays = ("means", "quats", "scales", "opacities", "sh", "labels", "thickness")
    return {name: getattr(cloud, name)[order] for name in arrays}


def test_a_store_contains_exactly_the_splats_of_its_files(files, store):
    stored, given = store.cloud(), fs.SplatCloud.concatenate([fs.load_ply(file) for file in files])
    assert len(store) == len(given) == 2 * COUNT
    assert store.ellipsoids == "some"
    assert store.sh_degree == 1
    ours, theirs = sorted_by_position(stored), sorted_by_position(given)
    for name, array in theirs.items():
        assert np.array_equal(ours[name], array), name
    # coplanar groups of both files stay distinct, and are last
    assert np.array_equal(np.unique(stored.coplanar_groups), np.unique(given.coplanar_groups))
    assert (stored.coplanar_groups[store.header.pinned :] >= 0).all()
    assert (stored.coplanar_groups[: store.header.pinned] < 0).all()


def test_neighbours_in_space_are_near_in_order(store):
    chunks = store.nodes[store.nodes["level"] == 0]
    assert chunks["count"].max() <= 500
    assert chunks["count"].sum() == len(store)
    sides = (chunks["high"] - chunks["low"]).prod(axis=1)
    low, high = store.bounds()
    assert np.median(sides) < np.prod(high - low) / 20


@pytest.mark.parametrize("sigmas", [0.0, 2.0, 5.0, 9.0])
def test_boxes_contain_their_splats(store, sigmas):
    low, high = store.bounding_boxes(sigmas)
    for number in range(len(store.nodes)):
        part = store.load(number)
        reach = sigmas * np.maximum(part["scales"].max(axis=1), part["thickness"])[:, None]
        assert (part["means"] - reach >= low[number] - 1e-12).all()
        assert (part["means"] + reach <= high[number] + 1e-12).all()


def test_every_node_replaces_four_of_the_level_below(store):
    nodes, inner = store.nodes, store.nodes["level"] > 0
    pinned = (nodes["level"] == 0) & (nodes["first"] >= store.header.pinned)
    roots = np.flatnonzero((nodes["parent"] < 0) & ~pinned)
    assert len(roots) == 1
    assert nodes["level"][roots[0]] == nodes["level"].max()
    assert (nodes["parent"][pinned] < 0).all()
    for number in np.flatnonzero(inner):
        children = nodes[nodes["parent"] == number]
        assert 1 <= len(children) <= REDUCTION
        assert (children["level"] == nodes["level"][number] - 1).all()
        # a quarter, but where splats lie on top of each other
        assert nodes["count"][number] < children["count"].sum() or children["count"].sum() < 2 * REDUCTION
        for name, furthest in (("size", np.max), ("reach", np.max), ("high", np.max), ("far_high", np.max)):
            assert (nodes[name][number] >= furthest(children[name], axis=0)).all()
        assert (nodes["far_low"][number] <= children["far_low"].min(axis=0)).all()


def test_labels_are_read_by_chunks(store):
    tracemalloc.start()
    labels = store.labels()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert labels == set(store.cloud().labels.tolist())
    assert peak < len(store) * 4 / 2


def copied(store, tmp_path):
    folder = tmp_path / "copy.fss"
    folder.mkdir()
    for name, content in contents(store.path).items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize(("column", "row"), [("means", 0), ("sh", 700), ("labels", 2 * COUNT - 1)])
def test_verify_reports_the_chunk_of_a_flipped_bit(store, tmp_path, column, row):
    folder = copied(store, tmp_path)
    file, content = folder / f"{column}.npy", bytearray((folder / f"{column}.npy").read_bytes())
    size = np.load(file, mmap_mode="r")[0].nbytes
    content[NPY_HEADER + row * size + 1] ^= 4
    file.write_bytes(content)
    wrong = fs.Store(folder).verify()
    ends = store.nodes["first"] + store.nodes["count"]
    chunk = int(np.flatnonzero((store.nodes["first"] <= row) & (row < ends))[0])
    assert len(wrong) == 1
    assert wrong[0].startswith(f"chunk {chunk}, rows ")
    assert store.verify() == []


def test_a_truncated_column_is_refused_with_its_chunk(store, tmp_path):
    folder, node = copied(store, tmp_path), store.nodes[3]
    row = int(node["first"]) + 1
    file = folder / "quats.npy"
    file.write_bytes(file.read_bytes()[: 128 + 16 * row])
    with pytest.raises(fs.InputError, match=f"rows from {row} on are missing, from chunk 3 on"):
        fs.Store(folder)


def test_an_incomplete_store_is_refused(store, tmp_path):
    def refused(match):
        with pytest.raises(fs.InputError, match=match):
            fs.Store(folder)

    folder = tmp_path / "none.fss"
    refused("must be the folder of a store, got nothing")
    folder = copied(store, tmp_path)
    original = contents(folder)
    for name in original:
        (folder / name).unlink()
        refused("a store with store.json|cannot read")
        (folder / name).write_bytes(original[name][: len(original[name]) * 2 // 3])
        refused("damaged|truncated")
        (folder / name).write_bytes(original[name])
    header = json.loads(original["store.json"])
    for change, match in [
        ({"version": 2}, "the version of the store .* must be 1, got 2"),
        ({"format": "zip"}, "another format"),
        ({"rows": -1}, "out of range"),
        ({"columns": []}, "not a table"),
        ({"rows": header["rows"] + 1}, "without gaps"),
        ({"columns": {"means": "<f4"}}, "no column"),
        ({"nodes_crc": 1}, "checksum"),
        ({"origin": [0, 0]}, "origin"),
    ]:
        changed_header = header | change
        (folder / "store.json").write_text(json.dumps(changed_header | {"crc": header_crc(changed_header)}))
        refused(match)
    (folder / "store.json").write_text(json.dumps(header | {"pinned": header["pinned"] - 1}))
    refused(r"store.json is damaged \(its checksum differs\)")
    (folder / "store.json").write_bytes(original["store.json"])
    nodes = np.load(folder / "nodes.npy")
    assert nodes.dtype == NODE
    nodes["count"][0] += 1
    np.save(folder / "nodes.npy", nodes)
    refused("its checksum differs")


def crafted(folder, nodes=None, **changes):
    """Change a store and its checksums."""
    header = json.loads((folder / "store.json").read_text()) | changes
    if nodes is not None:
        np.save(folder / "nodes.npy", nodes)
        header["nodes_crc"] = zlib.crc32(nodes.tobytes())
    (folder / "store.json").write_text(json.dumps(header | {"crc": header_crc(header)}))


@pytest.mark.parametrize(
    ("name", "number", "value", "match"),
    [
        ("count", 0, -5, "1 to 500 splats"),
        ("count", 1, 0, "1 to 500 splats"),
        ("count", 1, 501, "1 to 500 splats"),
        ("count", -1, 2**31 - 1, "must have at most 16777216 splats"),
        ("first", 1, 0, "rows without gaps"),
        ("first", 0, -1, "rows without gaps"),
        ("first", -1, 2**62, "rows without gaps"),
        ("level", -1, 2**31 - 1, "levels must rise"),
        ("level", 0, -1, "levels must rise"),
        ("level", 0, 1, "levels must rise"),
        ("parent", 0, 2**30, "in the level above"),
        ("parent", 0, -2, "in the level above"),
        ("parent", 0, 0, "in the level above"),
        ("parent", -1, 0, "in the level above"),
        ("size", 0, 0.1, "0 for chunks"),
        ("size", -1, -0.1, "at least 0"),
        ("size", -1, np.nan, "finite"),
        ("reach", 2, -1.0, "at least 0"),
        ("low", 2, np.inf, "finite"),
        ("low", 2, 1e9, "within the larger box"),
        ("far_high", 2, -1e9, "within the larger box"),
    ],
)
def test_an_index_that_contradicts_its_header_is_refused(store, tmp_path, name, number, value, match):
    """Also with valid checksums: a negative count would overrun buffers."""
    folder, nodes = copied(store, tmp_path), store.nodes.copy()
    nodes[name][number] = value
    crafted(folder, nodes)
    with pytest.raises(
        fs.InputError, match=rf"nodes.npy does not match store.json: .*{match}.*; build the store"
    ):
        fs.Store(folder)


def test_a_header_that_contradicts_its_index_is_refused(store, tmp_path):
    folder, columns = copied(store, tmp_path), store.header.columns
    for changes, match in [
        ({"splats": store.header.splats - 1}, "chunks must have"),
        ({"chunk": 100}, "1 to 100 splats"),
        ({"pinned": store.header.pinned - 1}, "begin with a chunk"),
        ({"pinned": 0}, "must have no parent"),
        ({"pinned": -1}, "out of range"),
        ({"rows": 2**62}, "out of range"),
        ({"columns": columns | {"means": "<f8"}}, "the column means must have the type <f4, got <f8"),
        ({"columns": columns | {"labels": "<f4"}}, "the column labels must have the type <i4, got <f4"),
        ({"columns": columns | {"../x": "<f4"}}, "the column ../x"),
        ({"sh_degree": -1}, "the column sh"),
        ({"ellipsoids": "maybe"}, "must be none, some or all"),
        ({"origin": [0, 0, 1e300]}, "origin"),
        ({"identity": 5}, "is not text"),
        ({"dropped": {"nan": "<b>"}}, "not whole numbers"),
    ]:
        header = (store.path / "store.json").read_bytes()
        (folder / "store.json").write_bytes(header)
        crafted(folder, **changes)
        with pytest.raises(fs.InputError, match=match):
            fs.Store(folder)
    (folder / "store.json").write_bytes(header)
    assert len(fs.Store(folder)) == len(store)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"chunk": 3}, "chunk must be .* got 3"),
        ({"memory": "2"}, "memory must be .* got '2'"),
        ({"colors": "uint8"}, "one of float32, float16"),
        ({"sh_degree": 4}, "sh_degree must be .* got 4"),
    ],
)
def test_invalid_build_options_are_refused(files, tmp_path, options, match):
    with pytest.raises(fs.InputError, match=match):
        fs.build_store(files, tmp_path / "a.fss", **options)


def test_invalid_names_are_refused(files, store, tmp_path):
    with pytest.raises(fs.InputError, match=r"must end with \.fss"):
        fs.build_store(files, tmp_path / "a.ply")
    with pytest.raises(fs.InputError, match="at least one splat file"):
        fs.build_store([], tmp_path / "a.fss")
    with pytest.raises(fs.InputError, match="--overwrite"):
        fs.build_store(files, store.path)
    other = tmp_path / "notes.fss"
    other.mkdir()
    (other / "notes.txt").touch()
    with pytest.raises(fs.InputError, match="exists and is not a store"):
        fs.build_store(files, other, overwrite=True)
    folder = copied(store, tmp_path)
    fs.build_store(files[1:], folder, overwrite=True, **SMALL)
    assert len(fs.Store(folder)) == COUNT


def test_colours_are_stored_in_the_requested_type(files, store, tmp_path):
    half = fs.Store(fs.build_store(files, tmp_path / "half.fss", colors="float16", **SMALL))
    error = np.abs(half.cloud().sh - store.cloud().sh).max()
    assert half.cloud().sh.dtype == np.float32
    assert 0 < error < 2e-3
    assert half.header.columns["sh"] == "<f2"
    assert half.nbytes < 0.8 * store.nbytes
    plain = fs.Store(fs.build_store(files, tmp_path / "plain.fss", sh_degree=0, levels=False, **SMALL))
    assert plain.sh_degree == -1
    assert (plain.nodes["level"] == 0).all()
    colors = C0 * store.cloud().sh[:, 0] + 0.5
    assert plain.cloud().colors == pytest.approx(np.maximum(colors, 0), abs=1e-6)


def test_an_instanced_store_repeats_the_splats(store, files, tmp_path):
    flat = fs.Store(fs.build_store(files[1:], tmp_path / "one.fss", **SMALL))
    with pytest.raises(fs.InputError, match="coplanar groups"):
        fs.place_store(store, tmp_path / "p.fss", [np.eye(4)])
    poses = [np.eye(4), rigid_matrix((30, 1, 2), (1, 0.2, -0.5, 0.1))]
    street = fs.Store(fs.place_store(flat, tmp_path / "street.fss", poses))
    wrong = fs.place_store(flat, tmp_path / "wrong.fss", poses)
    crafted(wrong, splats=len(flat))
    with pytest.raises(fs.InputError, match="does not match the poses of the store; place the store again"):
        fs.Store(wrong)
    assert len(street) == 2 * len(flat)
    assert street.chunks == 2 * flat.chunks
    cloud, moved = street.cloud(), flat.cloud().transformed(poses[1])
    assert np.array_equal(cloud.means[: len(flat)], flat.cloud().means)
    assert cloud.means[len(flat) :] == pytest.approx(moved.means, abs=1e-5)
    assert np.abs((cloud.quats[len(flat) :] * moved.quats).sum(axis=1)) == pytest.approx(1, abs=1e-6)
    low, high = street.bounding_boxes(FAR)
    for number in range(2 * len(flat.nodes)):
        part, one = street.load(number), number % len(flat.nodes)
        reach = FAR * np.maximum(part["scales"].max(axis=1), part["thickness"])[:, None]
        assert (part["means"] - reach >= low[number]).all()
        assert (part["means"] + reach <= high[number]).all()
        if flat.nodes["level"][one] == 0:
            first = int(street.first_of(np.array([number]))[0])
            assert np.array_equal(cloud.means[first : first + len(part["means"])], part["means"])
    with pytest.raises(fs.InputError, match="got an instanced store"):
        fs.place_store(street, tmp_path / "q.fss", poses)
    with pytest.raises(fs.InputError, match="pose 1 must be rigid"):
        fs.place_store(flat, tmp_path / "q.fss", [np.eye(4), np.diag([2.0, 2, 2, 1])])
    with pytest.raises(fs.InputError, match="at least one rigid"):
        fs.place_store(flat, tmp_path / "q.fss", [])
    file, content = street.path / "places.npy", bytearray((street.path / "places.npy").read_bytes())
    content[-40] ^= 1  # of a translation: as rigid as before
    file.write_bytes(content)
    with pytest.raises(fs.InputError, match=r"places\.npy is damaged"):
        fs.Store(street.path)
    content[-40] ^= 1
    file.write_bytes(content)
    fs.build_store(files[1:], flat.path, overwrite=True, chunk=400, memory=1 << 20)
    with pytest.raises(fs.InputError, match="place the store again"):
        fs.Store(street.path)


def test_sh_is_rotated_with_its_splats(store, files, tmp_path):
    from fidsplat.store.partial_cloud import transformed

    part = store.load(0)
    pose = rigid_matrix((1, 2, 3), (0.3, 0.1, -0.7, 0.2))
    turned = transformed(part, pose[:3, :3], pose[:3, 3])
    cloud = fs.SplatCloud(
        part["means"], part["quats"], part["scales"], part["opacities"], sh=part["sh"]
    ).transformed(pose)
    assert turned["sh"] == pytest.approx(cloud.sh, abs=1e-5)
    few = transformed({name: array[7:9] for name, array in part.items()}, pose[:3, :3], pose[:3, 3])
    assert all(np.array_equal(few[name], turned[name][7:9]) for name in few)
