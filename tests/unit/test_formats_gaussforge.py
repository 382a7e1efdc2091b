"""Splat files as another's readers and writers have them: GaussForge (C++, Apache 2.0), extra `test`."""

import numpy as np
import pytest
from test_formats import some
from test_formats_sog import sog

import fidsplat as fs

gaussforge = pytest.importorskip("gaussforge", reason="pip install 'fidsplat[test]'")
TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""from SPZ's axes, y up, to ours; GaussForge leaves them as they are in the file"""


def converted(file, to: str, **more):
    """The file next to it in another format, written by GaussForge."""
    kind = "".join(file.suffixes)[1:]
    actual = gaussforge.GaussForge().convert(file.read_bytes(), kind, to, **more)
    assert "error" not in actual, actual
    written = file.with_name(f"theirs.{to}")
    written.write_bytes(actual["data"])
    return written


def gaussforge_splats(file) -> fs.SplatCloud:
    """Splats read by GaussForge, from its own arrays: logarithms of scales, logits of opacities. Its
    Python module returns no cloud without higher SH."""
    model = gaussforge.GaussForge().read(file.read_bytes(), file.suffix[1:])
    assert "error" not in model, model
    model = model["data"]
    count, degree = model["numPoints"], model["meta"]["shDegree"]
    part = {name: np.frombuffer(value, "<f4") for name, value in model.items() if isinstance(value, bytes)}
    sh = np.concatenate(
        [part["colors"].reshape(count, 1, 3), part["sh"].reshape(count, (degree + 1) ** 2 - 1, 3)], axis=1
    )
    opacities = 1 / (1 + np.exp(-part["alphas"].astype(np.float64)))
    scales = np.exp(part["scales"].reshape(count, 3))
    return fs.SplatCloud(
        part["positions"].reshape(count, 3), part["rotations"].reshape(count, 4), scales, opacities, sh=sh
    )


def assert_same(cloud, other):
    one, two = (three_scales(each) for each in (cloud, other))
    # the smallest scale of SPZ, a disk's third one
    np.testing.assert_allclose(one, two, rtol=1e-5, atol=4.6e-5)
    np.testing.assert_allclose(cloud.means, other.means, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(cloud.opacities, other.opacities, atol=2e-6)
    np.testing.assert_allclose(np.abs((cloud.quats * other.quats).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(cloud.sh, other.sh, atol=1e-6)


def three_scales(cloud):
    thickness = np.zeros(len(cloud)) if cloud.thickness is None else cloud.thickness
    return np.column_stack([cloud.scales, thickness])


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("suffix", [".spz", ".ply"])
def test_a_file_of_ours_by_another_reader(tmp_path, degree, suffix):
    file = tmp_path / f"a{suffix}"
    fs.save_splats(some(degree=degree), file)
    ours = fs.load_splats(file)
    assert_same(gaussforge_splats(file), ours.transformed(TURN) if suffix == ".spz" else ours)


def test_a_splat_file_of_ours_by_another_reader(tmp_path):
    """Which hands it on as a PLY."""
    fs.save_splats(some(degree=0), tmp_path / "a.splat")
    assert_same(fs.load_splats(converted(tmp_path / "a.splat", "ply")), fs.load_splats(tmp_path / "a.splat"))


@pytest.mark.parametrize(
    ("kind", "more", "degrees"),
    [
        ("splat", {}, 1.5),
        ("spz", {"spz_version": 2}, 10),  # it leaves w out, which is little known where it is small
        ("spz", {"spz_version": 3}, 0.3),
        ("compressed.ply", {}, 0.3),
    ],
)
def test_a_file_of_another_writer(tmp_path, kind, more, degrees):
    fs.save_splats(some(degree=1), tmp_path / "a.ply")
    written = converted(tmp_path / "a.ply", kind, **more)
    ours, cloud = fs.load_splats(written), some(degree=1)
    if kind == "spz":
        ours = ours.transformed(TURN)
        assert_same(gaussforge_splats(written), ours)
    np.testing.assert_allclose(ours.means, cloud.means, atol=4e-3)  # 11 bits of a compressed PLY's 6 m
    np.testing.assert_allclose(ours.opacities, cloud.opacities, atol=1 / 255)  # it rounds down
    np.testing.assert_allclose(ours.sh[:, 0], cloud.sh[:, 0], atol=0.02)
    turns = np.degrees(2 * np.arccos(np.abs((ours.quats * cloud.quats).sum(1)).clip(0, 1)))
    assert turns.max() < degrees
    thick = np.asarray(cloud.thickness) > 0
    np.testing.assert_allclose(
        np.log(three_scales(ours)[thick]), np.log(three_scales(cloud)[thick]), atol=1 / 32 + 1e-5
    )


def test_a_sog_file_by_another_reader(tmp_path):
    sog(tmp_path / "a.sog")
    assert_same(gaussforge_splats(tmp_path / "a.sog"), fs.load_splats(tmp_path / "a.sog"))
