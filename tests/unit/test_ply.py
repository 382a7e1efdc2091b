"""PLY files: content of written files, and reading of the layouts of 2DGS and 3DGS."""

import math
import os
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fidsplat as fs
from fidsplat.formats import collect
from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import quaternion_to_matrix

F32 = np.float32
PLAIN = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
PLAIN += ["rot_0", "rot_1", "rot_2", "rot_3"]


def cloud_of(n=50, degree=3, seed=0, **changes):
    r = np.random.default_rng(seed)
    fields = {
        "means": r.normal(size=(n, 3)).astype(F32),
        "quats": r.normal(size=(n, 4)).astype(F32),
        "scales": np.exp(r.uniform(-9, 1, (n, 2))).astype(F32),
        "opacities": r.random(n, dtype=F32),
    }
    if degree < 0:
        fields["colors"] = r.random((n, 3), dtype=F32)
    else:
        fields["sh"] = r.normal(size=(n, (degree + 1) ** 2, 3)).astype(F32)
    return fs.SplatCloud(**fields | changes)


def write(path, columns, n, kinds=None, comments=()):
    """A PLY file by hand: columns is name -> values or one value, written in that order."""
    dtype = np.dtype([(name, (kinds or {}).get(name, "<f4")) for name in columns])
    rows = np.zeros(n, dtype)
    for name, values in columns.items():
        rows[name] = values
    words = {"<f4": "float", "<f8": "double", "<i4": "int", "|u1": "uchar", "<u4": "uint"}
    words |= {"|i1": "char", "<i2": "short", "<u2": "ushort"}
    head = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {c}" for c in comments),
        f"element vertex {n}",
    ]
    head += [f"property {words[dtype[name].str]} {name}" for name in columns]
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + rows.tobytes())
    return path


def assert_same(read, cloud):
    assert np.array_equal(read.means, cloud.means)
    assert np.array_equal(read.quats, cloud.quats)
    assert np.array_equal(read.origin, cloud.origin)
    assert np.array_equal(read.labels, cloud.labels)
    np.testing.assert_allclose(read.scales, cloud.scales, rtol=2e-6)
    np.testing.assert_allclose(read.opacities, cloud.opacities, rtol=2e-5, atol=1e-7)
    if cloud.sh is not None:
        assert np.array_equal(read.sh, cloud.sh)


@pytest.mark.parametrize("native", [False, True])
@pytest.mark.parametrize("degree", range(4))
def test_round_trip(tmp_path, degree, native):
    cloud = cloud_of(degree=degree)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fs.save_ply(cloud, tmp_path / "a.ply", native_2dgs=native)
        assert_same(fs.load_ply(tmp_path / "a.ply"), cloud)


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 9),
    degree=st.integers(-1, 3),
    native=st.booleans(),
    labels=st.integers(-(2**31), 2**31 - 1),
    origin=st.none() | st.tuples(*[st.floats(-1e8, 1e8)] * 3),
    opacity=st.floats(0, 1, width=32),
)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip_of_anything(tmp_path, seed, n, degree, native, labels, origin, opacity):
    cloud = cloud_of(n, degree, seed, labels=labels, origin=origin, opacities=np.full(n, opacity, F32))
    fs.save_ply(cloud, tmp_path / "a.ply", native_2dgs=native)
    read = fs.load_ply(tmp_path / "a.ply")
    assert_same(read, cloud)
    if degree < 0:
        np.testing.assert_allclose(0.5 + C0 * read.sh[:, 0], cloud.colors, atol=2e-7)


def test_header_is_that_of_the_2dgs_authors(tmp_path):
    fs.save_ply(cloud_of(3, 1), tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    head, data = content.split(b"end_header\n")
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 3",
        *(f"property float {n}" for n in names),
    ]
    assert head.decode().splitlines() == lines
    rows = np.frombuffer(data, "<f4").reshape(3, len(names))
    np.testing.assert_allclose(rows[:, names.index("scale_2")], np.log(1e-6), rtol=1e-6)
    assert not rows[:, 3:6].any()


def test_higher_bands_are_stored_by_channel(tmp_path):
    cloud = cloud_of(2, 1)
    fs.save_ply(cloud, tmp_path / "a.ply", native_2dgs=True)
    data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1]
    rows = np.frombuffer(data, "<f4").reshape(2, -1)
    assert np.array_equal(rows[:, 6:9], cloud.sh[:, 0])
    for channel in range(3):
        assert np.array_equal(rows[:, 9 + 3 * channel : 12 + 3 * channel], cloud.sh[:, 1:, channel])


def test_opacity_0_and_1_come_back_exactly(tmp_path):
    edge = np.array([0, 1, 1 - 2.0**-24, 2.0**-24, 1e-30, 0.5], F32)
    fs.save_ply(cloud_of(6, opacities=edge), tmp_path / "a.ply")
    read = fs.load_ply(tmp_path / "a.ply").opacities
    assert read[[0, 1, 5]].tolist() == [0, 1, 0.5]
    np.testing.assert_allclose(read, edge, rtol=1e-5, atol=1e-7)
    data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1]
    assert np.isfinite(np.frombuffer(data, "<f4")).all()


def test_splats_thinner_than_the_third_axis_written_for_others_stay_upright(tmp_path):
    cloud = cloud_of(4, scales=np.array([[1e-8, 1e-7], [1e-9, 1], [1, 1e-9], [1, 1]], F32))
    fs.save_ply(cloud, tmp_path / "a.ply")
    assert_same(fs.load_ply(tmp_path / "a.ply"), cloud)


@pytest.mark.parametrize("n", [1, 2047, 2048, 2049, 70000])
def test_sizes_around_the_blocks(tmp_path, n):
    cloud = cloud_of(n, 0)
    fs.save_ply(cloud, tmp_path / "a.ply")
    assert_same(fs.load_ply(tmp_path / "a.ply"), cloud)


def test_properties_in_any_order_of_any_float_type_among_others(tmp_path):
    r = np.random.default_rng(0)
    values = {name: r.normal(size=5).astype(F32) for name in PLAIN}
    order = ["red", *reversed(PLAIN), "confidence", "label"]
    columns = {name: values.get(name, 7) for name in order}
    kinds = {"red": "|u1", "x": "<f8", "opacity": "<f8", "label": "|u1", "confidence": "<f8"}
    read = fs.load_ply(write(tmp_path / "a.ply", columns, 5, kinds))
    assert np.array_equal(read.means, np.stack([values[a] for a in "xyz"], axis=1))
    np.testing.assert_allclose(read.scales[:, 1], np.exp(values["scale_1"]), rtol=1e-6)
    assert np.array_equal(read.sh[:, 0, 2], values["f_dc_2"])
    assert read.labels.tolist() == [7] * 5


@pytest.mark.parametrize(
    ("kind", "label"), [("|u1", 200), ("|i1", -100), ("<u2", 40000), ("<i2", -30000), ("<i4", -(2**31))]
)
def test_a_label_of_any_whole_type_that_an_int32_holds(tmp_path, kind, label):
    columns = {name: 1.0 for name in PLAIN} | {"label": label}
    read = fs.load_ply(write(tmp_path / "a.ply", columns, 2, {"label": kind}))
    assert read.labels.tolist() == [label] * 2


@pytest.mark.parametrize("kind", ["<f4", "<u4"])
def test_a_label_that_is_not_an_int32_is_someone_elses(tmp_path, kind):
    columns = {name: 1.0 for name in PLAIN} | {"label": 3}
    assert fs.load_ply(write(tmp_path / "a.ply", columns, 2, {"label": kind})).labels.tolist() == [0, 0]


def test_windows_line_ends(tmp_path):
    fs.save_ply(cloud_of(3, 0), tmp_path / "a.ply")
    head, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    (tmp_path / "b.ply").write_bytes((head + b"end_header\n").replace(b"\n", b"\r\n") + data)
    assert_same(fs.load_ply(tmp_path / "b.ply"), cloud_of(3, 0))


def test_elements_before_and_after_the_vertices(tmp_path):
    cloud = cloud_of(3, 0)
    fs.save_ply(cloud, tmp_path / "a.ply")
    head, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    head = head.replace(b"element vertex", b"element camera 2\nproperty double t\nelement vertex")
    content = head + b"element info 1\nproperty uchar a\nend_header\n" + b"\xff" * 16 + data + b"\x07"
    (tmp_path / "b.ply").write_bytes(content)
    assert_same(fs.load_ply(tmp_path / "b.ply"), cloud)


def test_far_double_positions_get_an_origin(tmp_path):
    columns = {name: 1.0 for name in PLAIN} | {
        "x": [4500000.125, 4500001.3, 4500002.7],
        "scale_0": -3,
        "scale_1": -3,
    }
    read = fs.load_ply(write(tmp_path / "a.ply", columns, 3, {"x": "<f8"}))
    assert read.origin[0] > 4e6
    np.testing.assert_allclose(read.world_means()[:, 0], columns["x"], rtol=0, atol=1e-6)


def test_infinite_logits_and_logarithms(tmp_path):
    columns = {name: 1.0 for name in PLAIN}
    columns["opacity"] = [np.inf, -np.inf, 0, 0, 0]
    columns["scale_0"] = [0, 0, -np.inf, 200, np.nan]
    path = write(tmp_path / "a.ply", columns, 5)
    with pytest.warns(UserWarning, match="3 of 5 splats left out"):
        read = fs.load_ply(path)
    assert read.opacities.tolist() == [1, 0]
    assert read.dropped == {"scales not finite": 2, "scale not above 0": 1}


def test_reading_needs_little_more_memory_than_the_cloud(tmp_path):
    fs.save_ply(cloud_of(30000), tmp_path / "a.ply", native_2dgs=True)
    tracemalloc.start()
    read = fs.load_ply(tmp_path / "a.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    size = sum(getattr(read, name).nbytes for name in ("means", "quats", "scales", "opacities", "sh"))
    assert peak < 1.25 * size + 1e6


def thick_cloud(n: int) -> fs.SplatCloud:
    r = np.random.default_rng(n)
    scales = r.uniform(0.1, 1, (n, 3))
    return fs.SplatCloud(
        r.normal(size=(n, 3)), r.normal(size=(n, 4)), scales, r.random(n), sh=r.random((n, 4, 3))
    )


def three_scales(tmp_path, quats, scales):
    columns = {name: 1.0 for name in PLAIN}
    columns |= {f"rot_{i}": np.asarray(quats)[:, i] for i in range(4)}
    with np.errstate(divide="ignore"):
        columns |= {f"scale_{i}": np.log(np.asarray(scales)[:, i]) for i in range(3)}
    return write(tmp_path / "a.ply", columns, len(scales))


@pytest.mark.parametrize("thin", range(3))
def test_3dgs_splats_are_ellipsoids_as_the_file_has_them(tmp_path, thin):
    r = np.random.default_rng(thin)
    scales = np.exp(r.uniform(-1, 1, (40, 3)))
    scales[:, thin] = 1e-4
    quats = r.normal(size=(40, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    path = three_scales(tmp_path, quats, scales)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = fs.load_ply(path)
    np.testing.assert_allclose(np.column_stack([read.scales, read.thickness]), scales, rtol=1e-5)
    np.testing.assert_allclose(read.quats, quats, atol=1e-6)


def test_the_3d_filter_of_mip_splatting_is_applied(tmp_path):
    """Wider, and as much fainter as the density falls; by 0 they stay, and one that is none is no splat."""
    columns = {name: 1.0 for name in PLAIN} | {"opacity": 0.0}
    columns |= {f"scale_{i}": [np.log(0.3), np.log(0.3), -np.inf, 0.0] for i in range(3)}
    columns["scale_1"][0] = np.log(0.4)
    columns["filter_3D"] = [0.4, 0.0, 0.4, np.nan]
    with pytest.warns(UserWarning, match="1 of 4 splats left out"):
        read = fs.load_ply(write(tmp_path / "a.ply", columns, 4))
    scales = [[0.5, math.hypot(0.4, 0.4), 0.5], [0.3] * 3, [0.4] * 3]
    np.testing.assert_allclose(np.column_stack([read.scales, read.thickness]), scales, rtol=1e-6)
    np.testing.assert_allclose(read.opacities, [0.5 * 0.36 * math.sqrt(0.5), 0.5, 0.0], rtol=1e-5)


def test_ellipsoids_and_disks_come_back_together(tmp_path):
    cloud = fs.SplatCloud.concatenate([cloud_of(3, 1), thick_cloud(4), cloud_of(2, 1)])
    assert cloud.thickness.tolist()[:3] == [0, 0, 0]
    assert (cloud.thickness[3:7] > 0).all()
    fs.save_ply(cloud, tmp_path / "a.ply")
    read = fs.load_ply(tmp_path / "a.ply")
    assert_same(read, cloud)
    np.testing.assert_allclose(read.thickness, cloud.thickness, rtol=1e-5)
    assert read.thickness.tolist()[:3] == [0, 0, 0]


def test_two_scales_cannot_hold_an_ellipsoid(tmp_path):
    with pytest.raises(
        fs.InputError, match=r"splats must be disks for native_2dgs, got 4 3D Gaussians of 4; use"
    ):
        fs.save_ply(thick_cloud(4), tmp_path / "a.ply", native_2dgs=True)
    fs.save_ply(thick_cloud(4).flattened(), tmp_path / "a.ply", native_2dgs=True)
    assert fs.load_ply(tmp_path / "a.ply").thickness is None


@pytest.mark.parametrize("thin", range(3))
def test_an_axis_of_0_is_flat_and_one_of_nan_is_not_a_splat(tmp_path, thin):
    scales = np.array([[1, 1, 1], [1, np.nan, 1], [1, 1, np.inf], [np.nan, 0, 1], [1, 1, 1]], float)
    scales[0, thin] = 0
    path = three_scales(tmp_path, np.ones((5, 4)), scales)
    with pytest.warns(UserWarning, match="3 of 5 splats left out") as caught:
        read = fs.load_ply(path)
    assert len(caught) == 1
    assert read.scales.tolist() == [[1, 1], [1, 1]]
    assert read.thickness.tolist() == [0, 1]
    normal = quaternion_to_matrix(read.quats)[0, :, 2]
    np.testing.assert_allclose(normal, quaternion_to_matrix(np.ones((1, 4)) / 2)[0, :, thin], atol=1e-6)


@pytest.mark.parametrize("window", [1, 100])
@pytest.mark.parametrize(("third", "thickness"), [(1e-6, None), (1.005e-6, [0, 0, 1.005e-6])])
def test_a_third_scale_of_1e_6_is_padding(tmp_path, monkeypatch, window, third, thickness):
    """Even where it is not the thinnest."""
    monkeypatch.setattr(collect, "WINDOW", window)
    path = three_scales(tmp_path, np.ones((3, 4)), [[1, 1, 1e-6], [1, 0.5e-6, 1e-6], [1, 1, third]])
    read = fs.load_ply(path)
    np.testing.assert_allclose(read.scales[1], [1, 0.5e-6], rtol=1e-5)
    if thickness is None:
        assert read.thickness is None
    else:
        np.testing.assert_allclose(read.thickness, thickness, rtol=1e-5)


@pytest.mark.parametrize("labels", [0, 7])
def test_planes_come_back(tmp_path, labels):
    planes = np.arange(50, dtype=np.int32) % 4 - 1
    cloud = cloud_of(labels=labels).with_coplanar_groups(planes)
    fs.save_ply(cloud, tmp_path / "a.ply")
    read = fs.load_ply(tmp_path / "a.ply")
    assert_same(read, cloud)
    assert np.array_equal(read.coplanar_groups, planes)
    assert b"property int plane\n" in (tmp_path / "a.ply").read_bytes()


def test_a_cloud_without_planes_has_none_in_its_file(tmp_path):
    fs.save_ply(cloud_of(), tmp_path / "a.ply")
    assert b"plane" not in (tmp_path / "a.ply").read_bytes()
    assert fs.load_ply(tmp_path / "a.ply").coplanar_groups is None


def test_planes_and_labels_stay_with_their_splats_when_others_are_left_out(tmp_path):
    columns = {name: 1.0 for name in PLAIN} | {"opacity": [0, np.nan, 1, 2], "plane": [5, 6, -1, 8]}
    columns["label"] = [1, 2, 3, 4]
    path = write(tmp_path / "a.ply", columns, 4, {"plane": "<i4", "label": "|u1"})
    with pytest.warns(UserWarning, match="1 of 4 splats left out"):
        read = fs.load_ply(path)
    assert read.coplanar_groups.tolist() == [5, -1, 8]
    assert read.labels.tolist() == [1, 3, 4]
    assert read.dropped == {"opacities not finite": 1}


def test_a_plane_that_is_not_an_int32_is_someone_elses(tmp_path):
    columns = {name: 1.0 for name in PLAIN} | {"plane": 3}
    assert fs.load_ply(write(tmp_path / "a.ply", columns, 2, {"plane": "<f4"})).coplanar_groups is None


def test_a_plane_below_minus_one_is_an_error_that_names_the_file(tmp_path):
    columns = {name: 1.0 for name in PLAIN} | {"plane": [0, -7]}
    with pytest.raises(
        fs.InputError, match=r"a\.ply: the property 'plane' \(coplanar group\) must be .*, got -7"
    ):
        fs.load_ply(write(tmp_path / "a.ply", columns, 2, {"plane": "<i4"}))


def test_writing_replaces_the_old_file_or_leaves_it(tmp_path):
    path = tmp_path / "a.ply"
    path.write_text("old")
    fs.save_ply(cloud_of(), path)
    assert len(fs.load_ply(path)) == 50
    assert os.listdir(tmp_path) == ["a.ply"]


def test_a_folder_that_cannot_be_written(tmp_path):
    with pytest.raises(fs.InputError, match=r"cannot write .*missing"):
        fs.save_ply(cloud_of(), tmp_path / "missing" / "a.ply")
    with pytest.raises(fs.InputError, match="cannot write"):
        fs.save_ply(cloud_of(), tmp_path)
