"""Splat files other than PLY: round trips, content for an independent reader, and errors."""

import gzip
import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from full_disk import small_files

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.formats import losses
from fidsplat.formats.files import FORMATS
from fidsplat.formats.spz import save_spz
from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import quaternion_to_matrix, rigid_matrix

USD = [pytest.param(suffix, id=suffix) for suffix in (".usda", ".usdc", ".usd")]


def some(count=40, degree=2, thick=True, seed=4, **more) -> fs.SplatCloud:
    random = np.random.default_rng(seed)
    scales = random.uniform(0.01, 0.3, (count, 3))
    scales[::3, 2] = 0  # disks among them
    return fs.SplatCloud(
        random.uniform(-3, 3, (count, 3)).astype(np.float32), random.normal(size=(count, 4)),
        scales if thick else scales[:, :2], random.uniform(0, 1, count),
        sh=random.normal(0, 0.2, (count, (degree + 1) ** 2, 3)), **more,
    )  # fmt: skip


def need(suffix):
    if suffix.startswith(".us"):
        pytest.importorskip("pxr", reason="the extra usd is not installed")


def assert_same_bits(a: fs.SplatCloud, b: fs.SplatCloud):
    for name in ("means", "scales", "opacities", "labels", "sh", "thickness", "coplanar_groups"):
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_array_equal(one, other, err_msg=name)
    np.testing.assert_allclose(a.quats, b.quats, atol=1.2e-7)  # made of unit length once more


@pytest.mark.sweep
@pytest.mark.parametrize("suffix", [".glb", ".gltf", *USD])
@pytest.mark.parametrize("thick", [True, False])
def test_what_keeps_every_bit(tmp_path, suffix, thick):
    need(suffix)
    cloud = some(thick=thick, labels=np.arange(40) % 5)
    fs.save_splats(cloud, tmp_path / f"a{suffix}")
    assert_same_bits(fs.load_splats(tmp_path / f"a{suffix}"), cloud)
    assert losses(cloud, f"a{suffix}") == []


def test_a_gaussian_as_thin_as_a_disk_is_padded_is_not_a_disk(tmp_path):
    """But for rounding: half a percent more than the third scale of disks is a thickness."""
    disks, thin = some(4, thick=False), np.float32(1.005e-6)
    scales = np.column_stack([disks.scales, [0, thin, 0, 0.01]])
    cloud = fs.SplatCloud(disks.means, disks.quats, scales, disks.opacities, sh=disks.sh)
    fs.save_splats(cloud, tmp_path / "a.glb")
    thickness = fs.load_splats(tmp_path / "a.glb").thickness
    assert thickness is not None
    np.testing.assert_allclose(thickness, [0, thin, 0, 0.01], rtol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_is_as_near_as_its_bits(tmp_path, degree):
    cloud = some(degree=degree)
    fs.save_splats(cloud, tmp_path / "a.spz")
    read = fs.load_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(read.means, cloud.means, atol=0.5 / 2**20 + 3e-7)
    np.testing.assert_allclose(np.log(read.scales), np.log(cloud.scales), atol=1 / 32 + 1e-5)
    np.testing.assert_allclose(read.opacities, cloud.opacities, atol=0.5 / 255 + 1e-6)
    assert ((read.thickness > 0) == (cloud.thickness > 0)).all()
    turn = np.abs((read.quats * cloud.quats).sum(axis=1))
    assert np.degrees(2 * np.arccos(turn.clip(0, 1))).max() < 0.3
    assert np.abs(read.sh[:, 0] - cloud.sh[:, 0]).max() < 0.5 / 255 / 0.15 + 1e-5
    if degree:
        assert np.abs(read.sh[:, 1:] - cloud.sh[:, 1:]).max() < 0.5 / 128 * 2.5  # turned after rounding
    assert "rounds positions to 24 bits" in losses(cloud, "a.spz")[-1]


def test_splat_is_as_near_as_its_bytes(tmp_path):
    cloud = some(degree=0)
    fs.save_splats(cloud, tmp_path / "a.splat")
    read = fs.load_splats(tmp_path / "a.splat")
    np.testing.assert_array_equal(read.means, cloud.means)
    np.testing.assert_allclose(read.scales, cloud.scales, rtol=1e-6)
    assert ((read.thickness > 0) == (cloud.thickness > 0)).all()
    np.testing.assert_allclose(read.opacities, cloud.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(read.plain_colors, cloud.plain_colors, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(np.abs((read.quats * cloud.quats).sum(axis=1)), 1, atol=1e-4)


# independent readers: the specifications, by other hands or word by word


def test_a_splat_file_word_by_word(tmp_path):
    half = math.sqrt(0.5)
    cloud = fs.SplatCloud([[1, 2, 3]], [[half, 0, half, 0]], [[0.5, 0.25]], [0.6], colors=[[1.0, 0.2, 0.0]])
    fs.save_splats(cloud, tmp_path / "a.splat")
    row = struct.unpack("<6f8B", (tmp_path / "a.splat").read_bytes())
    assert row[:5] == (1, 2, 3, 0.5, 0.25)
    assert row[5] == pytest.approx(1e-6)
    assert row[6:] == (255, 51, 0, 153, 219, 128, 219, 128)


def test_an_spz_file_word_by_word(tmp_path):
    """Axes are right, up and backwards; one splat, of which every field is worked out by hand."""
    cloud = fs.SplatCloud(
        [[1.0, 2.0, -0.5]], [[0.8, 0.0, 0.6, 0.0]], [[math.exp(-2), math.exp(-1)]], [0.2],
        sh=[[[0.0, 1.0, -1.0]] + [[0.5, 0.25, 0.0]] * 3],
    )  # fmt: skip
    save_spz(cloud, tmp_path / "a.spz", version=3)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert struct.unpack_from("<IIIBBBB", data) == (0x5053474E, 3, 1, 1, 20, 0, 0)
    places = [int.from_bytes(data[16 + 3 * i : 19 + 3 * i], "little", signed=True) / 2**20 for i in range(3)]
    assert places == [1.0, -2.0, 0.5]
    assert data[25] == 51
    assert list(data[26:29]) == [128, 166, 89]
    assert list(data[29:32]) == [128, 144, 0]
    word = int.from_bytes(data[32:36], "little")
    # half a turn about x times (0.8, 0, 0.6, 0) is (0, 0.8, 0, 0.6): x is the largest and left out
    assert word >> 30 == 0
    others = [
        ((-1 if word >> s + 9 & 1 else 1) * (word >> s & 511) / 511 / math.sqrt(2)) for s in (20, 10, 0)
    ]
    np.testing.assert_allclose(np.abs(others), [0, 0.6, 0], atol=1e-3)
    # bands of -y, z, -x: y and z change sign with the axes
    np.testing.assert_allclose(
        (np.array(list(data[36:45])) - 128) / 128, [-0.5, -0.25, 0] * 2 + [0.5, 0.25, 0]
    )
    assert len(data) == 45


def test_an_spz_file_of_version_2(tmp_path):
    """By hand: its rotations are three bytes, x, y, z."""
    body = struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 0, 0)
    body += b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (1.0, -2.0, 0.5))
    body += bytes([255, 128, 128, 128, 128, 128, 0, 128, 128, 255])
    (tmp_path / "a.spz").write_bytes(gzip.compress(body))
    cloud = fs.load_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(cloud.means, [[1.0, 2.0, -0.5]])
    normal = quaternion_to_matrix(cloud.quats)[0][:, 2]
    np.testing.assert_allclose(normal, [0, 0, -1], atol=0.02)  # half about z, then half about x
    assert cloud.thickness is None


def test_a_glb_file_by_another_reader(tmp_path):
    pygltflib = pytest.importorskip("pygltflib", reason="pygltflib reads glTF by itself")
    cloud = some(degree=1, labels=3)
    fs.save_splats(cloud, tmp_path / "a.glb")
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    blob, primitive = document.binary_blob(), document.meshes[0].primitives[0]
    assert document.extensionsUsed == ["KHR_gaussian_splatting"]
    assert primitive.mode == 0
    assert primitive.extensions["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    accessor = document.accessors[primitive.attributes.POSITION]
    view = document.bufferViews[accessor.bufferView]
    means = np.frombuffer(blob, "<f4", 3 * accessor.count, view.byteOffset).reshape(-1, 3)
    np.testing.assert_array_equal(means, cloud.means)
    np.testing.assert_allclose(accessor.min, cloud.means.min(axis=0))
    assert document.nodes[0].rotation == [0, 0, 1, 0]  # x to the left, y up, z forward


def test_a_usd_file_says_what_the_schema_wants(tmp_path):
    need(".usda")
    from pxr import Usd, UsdGeom

    cloud = some(degree=1, thick=False).with_coplanar_groups(3)
    fs.save_splats(cloud, tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField"
    assert "ParticleFieldKernelGaussianSurfletAPI" in prim.GetAppliedSchemas()
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    quaternion = prim.GetAttribute("orientations").Get()[7]
    np.testing.assert_allclose([quaternion.GetReal(), *quaternion.GetImaginary()], cloud.quats[7])
    assert list(prim.GetAttribute("positions").Get()[7]) == cloud.means[7].tolist()
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 1
    assert_same_bits(fs.load_splats(tmp_path / "a.usda"), cloud)


def test_a_gltf_of_nodes_bytes_and_a_neighbouring_file(tmp_path):
    """By hand: two nodes below each other, opacity in bytes, rotation in shorts, data in another file."""
    half = round(32767 * math.sqrt(0.5))
    data = (
        struct.pack("<3f", 1, 0, 0) + struct.pack("<4h", 0, 0, half, half) + struct.pack("<3f", 0.1, 0.2, 0.3)
    )
    data += struct.pack("<3f", 1, 0, -1) + bytes([51, 0, 0, 0])
    (tmp_path / "data.bin").write_bytes(data)
    layout = [(0, 12, 5126, "VEC3"), (12, 8, 5122, "VEC4"), (20, 12, 5126, "VEC3"), (32, 12, 5126, "VEC3")]
    layout.append((44, 4, 5121, "SCALAR"))
    prefix = "KHR_gaussian_splatting:"
    names = ["POSITION", *(prefix + name for name in ("ROTATION", "SCALE", "SH_DEGREE_0_COEF_0", "OPACITY"))]
    document = {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "translation": [0, 5, 0]}],
        "meshes": [{"primitives": [{
            "attributes": {name: i for i, name in enumerate(names)},
            "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse"}},
        }]}],
        "accessors": [
            {"bufferView": i, "componentType": kind, "count": 1, "type": shape, "normalized": kind != 5126}
            for i, (_, _, kind, shape) in enumerate(layout)
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": o, "byteLength": n} for o, n, _, _ in layout],
        "buffers": [{"byteLength": len(data), "uri": "data.bin"}],
    }  # fmt: skip
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(document))
    cloud = fs.load_splats(path)
    np.testing.assert_allclose(cloud.world_means(), [[-2, -10, 0]], atol=1e-6)
    np.testing.assert_allclose(cloud.scales, [[0.2, 0.4]], rtol=1e-6)
    np.testing.assert_allclose(cloud.thickness, [0.6], rtol=1e-6)
    np.testing.assert_allclose(cloud.opacities, [0.2], rtol=1e-6)
    np.testing.assert_allclose(cloud.plain_colors, [[0.5 + C0, 0.5, 0.5 - C0]], rtol=1e-6)
    axis = quaternion_to_matrix(cloud.quats)[0][:, 0]
    np.testing.assert_allclose(axis, [0, -1, 0], atol=1e-4)  # x to y, which is up
    for uri in ("../data.bin", "/etc/hostname", "https://a.example/data.bin", "%2e%2e/data.bin"):
        document["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(document))
        with pytest.raises(fs.InputError, match="must be in its folder, got"):
            fs.load_splats(path)
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside/link.bin").symlink_to(tmp_path / "data.bin")
    (tmp_path / "inside/loop.bin").symlink_to("loop.bin")
    for uri, words in (
        ("link.bin", "must be in its folder, got 'link.bin"),
        ("loop.bin", "must be in its folder, got 'loop.bin'"),
    ):
        document["buffers"][0]["uri"] = uri
        (tmp_path / "inside/a.gltf").write_text(json.dumps(document))
        with pytest.raises(fs.InputError, match=words):
            fs.load_splats(tmp_path / "inside/a.gltf")
    document["buffers"][0]["uri"] = "data.bin"
    document["accessors"][0]["count"] = math.inf
    path.write_text(json.dumps(document))
    with pytest.raises(fs.InputError, match=r"damaged \(OverflowError"):
        fs.load_splats(path)
    document["accessors"][0]["count"] = 1
    document["nodes"][1]["children"] = [0]
    path.write_text(json.dumps(document))
    with pytest.raises(fs.InputError, match="node 0 must have one parent and not be its own descendant"):
        fs.load_splats(path)


# bad input


def test_a_gltf_may_begin_with_as_many_spaces_as_it_likes(tmp_path):
    path, cloud = tmp_path / "a.gltf", some(count=9, degree=1)
    fs.save_splats(cloud, path)
    for spaces in (b"\n", b" " * 63, b" " * 64, b" \r\n\t" * 50_000):
        path.write_bytes(spaces + path.read_bytes().lstrip())
        assert_same_bits(fs.load_splats(path), cloud)
    path.write_bytes(b" " * 100)
    with pytest.raises(fs.InputError, match="not JSON"):
        fs.load_splats(path)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        (
            "a.glb",
            struct.pack("<4sI", b"glTF", 3),
            "the version of glTF must be 2, got 3; .* with splat-transform",
        ),
        ("a.gltf", b'{"asset": {"version": "1.0"}}', "must be 2, got 1.0; convert it by gltf-pipeline"),
        (
            "a.gltf",
            b'{"extensionsUsed": ["OLD"]}',
            r"must have splats, .* \(extensions: OLD\); .* splat-trans",
        ),
        ("a.usda", b"#usda 2.0\n", "usd-core can read, got '#usda 2.0'; convert a later version by usdcat"),
        ("a.ksplat", b"", "unknown suffix of a splat file '.ksplat'.*; convert it with splat-transform"),
        ("a.spz", b"", "cannot read .*a.spz: it is empty"),
        ("a.spz", b"ply\n", "got b'ply.n'; its content is PLY: rename it to a.ply"),
        ("a.glb", b"NGSP" + bytes(99), "its content is SPZ: rename it to a.spz"),
        (
            "a.dat",
            b"PXR-USDC",
            "unknown suffix .*; its content is OpenUSD ParticleField: rename it to a.usdc",
        ),
        ("a.toml", b"", "unknown suffix of a splat file '.toml'.*; fidsplat render, .* read scene files"),
    ],
)
def test_files_that_are_not_read_name_their_version_and_a_tool(tmp_path, name, data, words):
    """PLY: test_ply_damaged.py; SPZ: below; SOG: test_formats_sog*.py."""
    need(Path(name).suffix)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(fs.InputError, match=words):
        fs.load_splats(tmp_path / name)


def test_a_folder_with_a_splat_file_names_the_file(tmp_path, capsys):
    (tmp_path / "lod-meta.json").touch()
    for command in ("info", "render"):
        assert main([command, str(tmp_path)]) == 2
        assert f"name a file in the folder, such as {tmp_path}/lod-meta.json" in capsys.readouterr().err


@pytest.mark.sweep
@pytest.mark.parametrize("suffix", [".spz", ".splat", ".glb", ".gltf", *USD[:2]])
def test_files_that_are_cut_short_or_something_else(tmp_path, suffix):
    need(suffix)
    path = tmp_path / f"a{suffix}"
    fs.save_splats(some(count=9, degree=1), path)
    contents = path.read_bytes()
    last = len(contents.rstrip()) - 1  # text may do without its line's end
    for cut in sorted({0, 1, 5, 13, 25, len(contents) // 2, last, len(contents) - 7}):
        path.write_bytes(contents[:cut])
        with pytest.raises(fs.InputError, match=str(path)):
            fs.load_splats(path)
    path.write_bytes(b"\x89PNG" + bytes(100))
    with pytest.raises(fs.InputError, match=str(path)):
        fs.load_splats(path)
    path.unlink()
    with pytest.raises(fs.InputError, match="cannot read"):
        fs.load_splats(path)


def spz_4(path, **fields):
    """A file of version 4 of two splats, with changed header fields and inserted extensions."""
    fs.save_splats(some(count=2, degree=1), path)
    data = path.read_bytes()
    head = dict(zip(("magic", "version", "n", "degree", "point", "flags", "streams", "table"),
                    struct.unpack_from("<IIIBBBBI", data), strict=True))  # fmt: skip
    extensions = fields.pop("extensions", b"")
    old = head["table"]
    head |= {"table": old + len(extensions), "flags": 2 if extensions else 0} | fields
    path.write_bytes(struct.pack("<IIIBBBBI12x", *head.values()) + extensions + data[old:])
    return path


def test_an_spz_file_with_extensions(tmp_path):
    """Extensions that are not known are skipped; the coordinate system of Adobe's is applied."""
    plain = fs.load_splats(spz_4(tmp_path / "a.spz"))
    unknown = fs.load_splats(
        spz_4(tmp_path / "b.spz", extensions=struct.pack("<II3s", 0x12340001, 3, b"abc"))
    )
    np.testing.assert_array_equal(unknown.means, plain.means)
    axes = struct.pack("<III", 0xADBE0003, 4, 6)  # right, down, front: those of trained splats
    turned = fs.load_splats(spz_4(tmp_path / "c.spz", extensions=axes))
    np.testing.assert_allclose(turned.means, plain.means * [1, -1, -1])


def test_an_spz_file_keeps_labels_and_coplanar_groups(tmp_path):
    cloud = fs.marker("apriltag:36h11:5", size=0.16).gaussians.with_labels(7)
    fs.save_splats(cloud, tmp_path / "a.spz")
    again = fs.load_splats(tmp_path / "a.spz")
    np.testing.assert_array_equal(again.labels, cloud.labels)
    np.testing.assert_array_equal(again.coplanar_groups, cloud.coplanar_groups)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"n": 2**32 - 1}, "expand to"),
        ({"n": 3}, "array means must expand to 27 bytes"),
        ({"streams": 5}, "must have 6 arrays, got 5"),
        ({"table": 2**32 - 1}, "truncated: its table must end"),
        ({"degree": 5}, "SH degree 0 to 4"),
        ({"version": 3}, "damaged"),
        ({"extensions": b"abc"}, "extension is truncated"),
        ({"extensions": struct.pack("<II", 1, 2**32 - 1)}, "extension is truncated"),
        ({"extensions": struct.pack("<III", 0xADBE0003, 4, 2)}, "coordinate system must be one of"),
        ({"extensions": struct.pack("<III", 0xF1D50001, 4, 2)}, "damaged"),
    ],
)
def test_a_damaged_spz_file_of_version_4(tmp_path, fields, words):
    with pytest.raises(fs.InputError, match=words):
        fs.load_splats(spz_4(tmp_path / "a.spz", **fields))


@pytest.mark.parametrize("version", [1, 5])
def test_an_spz_file_of_another_version(tmp_path, version):
    """Also one that is cut short after its version."""
    head = struct.pack("<4sI", b"NGSP", version)
    words = rf"a\.spz: the version of SPZ must be 2, 3 or 4, got {version}; convert it by spz_to_ply"
    for data in (head, head + bytes(24), gzip.compress(head), gzip.compress(head + bytes(8))):
        (tmp_path / "a.spz").write_bytes(data)
        with pytest.raises(fs.InputError, match=words):
            fs.load_splats(tmp_path / "a.spz")


@pytest.mark.parametrize("wrap", [bytes, gzip.compress])
def test_an_spz_file_whose_header_is_cut_short(tmp_path, wrap):
    (tmp_path / "a.spz").write_bytes(wrap(struct.pack("<4sIH", b"NGSP", 3, 0)))
    with pytest.raises(fs.InputError, match=r"truncated: the header must have \d+ bytes, got 10"):
        fs.load_splats(tmp_path / "a.spz")


def test_an_spz_file_that_promises_more_than_gzip_can_hold(tmp_path):
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, 2**32 - 1, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head))
    with pytest.raises(fs.InputError, match=r"truncated: its header declares \d+ bytes"):
        fs.load_splats(tmp_path / "a.spz")


def test_a_small_spz_file_of_many_splats(tmp_path, monkeypatch):
    """20 bytes a splat, all 0, are packed a thousandfold."""
    monkeypatch.setattr("fidsplat.formats.spz._MAX_UNCHECKED", 100)
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, 1000, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + bytes(20 * 1000)))
    with pytest.raises(fs.InputError, match=r"1000 splats must have at least as many bytes, got \d\d"):
        fs.load_splats(tmp_path / "a.spz")
    monkeypatch.setattr("fidsplat.formats.spz._MAX_UNCHECKED", 1000)
    assert len(fs.load_splats(tmp_path / "a.spz")) == 1000


@pytest.mark.parametrize("suffix", [".spz", ".usda", ".usdc"])
def test_a_disk_that_is_full_leaves_the_old_file(tmp_path, suffix):
    need(suffix)
    path = tmp_path / f"a{suffix}"
    fs.save_splats(some(count=3), path)
    before = path.read_bytes()
    with small_files(20_000), pytest.raises(fs.InputError, match="cannot write"):
        fs.save_splats(some(count=4000), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz"])
def test_no_splats_are_read_as_none(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    fs.save_splats(fs.SplatCloud.empty(), path)
    assert len(fs.load_splats(path)) == 0


def test_what_cannot_be_written(tmp_path):
    tag = fs.marker("aruco:4x4_50:7", size=0.4)
    for suffix in (suffix for suffix, known in FORMATS.items() if known.save):
        need(suffix)
        with pytest.raises(fs.InputError, match=r"must be Gaussians, got .* boxes"):
            fs.save_splats(tag.cloud, tmp_path / f"a{suffix}")
        with pytest.raises(fs.InputError, match="cannot write"):
            fs.save_splats(tag.gaussians, tmp_path / f"none/a{suffix}")
    with pytest.raises(fs.InputError, match=r"unknown suffix of a splat file '.obj'"):
        fs.save_splats(tag.gaussians, tmp_path / "a.obj")
    for name in ("a.glb", "a.gltf", "a.splat"):
        with pytest.raises(fs.InputError, match="must have at least one splat, got none"):
            fs.save_splats(fs.SplatCloud.empty(), tmp_path / name)
    far = fs.SplatCloud([[1e8, 0, 0]], [[1, 0, 0, 0]], [[1, 1]], [1], colors=[[1, 1, 1]])
    with pytest.raises(fs.InputError, match="coordinates in SPZ must be at most 8,388,608 m"):
        fs.save_splats(far, tmp_path / "a.spz")
    assert list(tmp_path.iterdir()) == []


def test_what_a_format_cannot_hold_is_reported():
    cloud = some(labels=3, thick=False).with_coplanar_groups(1).transformed(rigid_matrix((1e6, 0, 0)))
    words = " ".join(losses(cloud, "a.splat"))
    for part in (
        "SH of degree 2",
        "labels (1 different)",
        "coplanar groups",
        "the origin: positions",
        "rounds colours",
    ):
        assert part in words
    assert losses(cloud, "a.ply") == []


# the command


def test_convert_says_what_it_costs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("fidsplat.scenes.sources.WIDTH", 64)
    monkeypatch.setattr("fidsplat.scenes.sources.HEIGHT", 36)
    fs.save_splats(some(labels=2), "a.ply")
    assert main(["convert", "a.ply", "a.glb", "--device", "reference", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["splats"], printed["lost"], printed["format"]) == (40, [], "glTF KHR_gaussian_splatting")
    assert printed["error"]["largest"] < 1e-5
    assert main(["convert", "a.ply", "a.splat", "--device", "reference"]) == 0
    out = capsys.readouterr().out
    assert "lost: labels (1 different)" in out
    assert "image error: largest 0." in out
    assert main(["convert", "a.ply", "b.splat", "--no-pictures"]) == 0
    assert "pictures" not in capsys.readouterr().out
    assert Path("b.splat").stat().st_size == 40 * 32
    assert main(["convert", "a.ply", "a.spz", "--spz-version", "3", "--no-pictures"]) == 0
    assert Path("a.spz").read_bytes()[:2] == b"\x1f\x8b"  # gzip
    assert main(["convert", "a.ply", "a.xyz"]) == 2
    assert "unknown suffix of a splat file '.xyz'" in capsys.readouterr().err
