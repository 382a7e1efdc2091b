"""Splat files read and written by splat-transform, skipped where it is not installed."""

import numpy as np
import pytest
import splat_transform
from test_formats import some
from test_formats_gaussforge import three_scales

import fidsplat as fs
from fidsplat.formats.plain import HALF_TURN
from fidsplat.splats.rotations import quaternion_to_matrix

pytestmark = splat_transform.NEEDED


def thick(**words) -> fs.SplatCloud:
    """Gaussians of three scales: a disk has no logarithm of its third."""
    cloud = some(count=60, **words)
    return fs.SplatCloud(
        cloud.means,
        cloud.quats,
        np.column_stack([cloud.scales, np.full(60, 0.05)]),
        cloud.opacities,
        sh=cloud.sh,
    )


def assert_close(one, other, means=1e-5, scales=0.033, degrees=0.4, opacities=0.0041, dc=0.02):
    np.testing.assert_allclose(one.means, other.means, atol=means)
    np.testing.assert_allclose(np.log(three_scales(one)), np.log(three_scales(other)), atol=scales)
    np.testing.assert_allclose(one.opacities, other.opacities, atol=opacities)
    np.testing.assert_allclose(one.sh[:, 0], other.sh[:, 0], atol=dc)
    # nianticlabs/spz also turns the frame of a splat, which leaves its axes up to their sign
    columns = (quaternion_to_matrix(one.quats) * quaternion_to_matrix(other.quats)).sum(1)
    assert np.abs(columns).min() > np.cos(np.radians(degrees))


def by_version(cloud) -> fs.SplatCloud:
    """The cloud, turned since version 3, whose SPZ files have the axes of PLY against the format."""
    return cloud.transformed(HALF_TURN) if splat_transform.version() >= 3 else cloud


@pytest.mark.parametrize("suffix", [".glb", ".spz"])
def test_files_of_splat_transform_have_the_pose_of_their_ply(tmp_path, suffix):
    cloud = thick(degree=1)
    fs.save_splats(cloud, tmp_path / "a.ply")
    theirs = fs.load_splats(splat_transform.converted(tmp_path / "a.ply", tmp_path / f"b{suffix}"))
    if suffix == ".spz":
        cloud = by_version(cloud)
    assert_close(theirs, cloud, means=1.3e-4)  # 12 bits after the point
    np.testing.assert_allclose(theirs.sh, cloud.sh, atol=0.07)


def test_splat_transform_reads_spz_4(tmp_path):
    cloud = thick(degree=3, labels=2)  # the extension with the labels is skipped
    fs.save_splats(cloud, tmp_path / "a.spz")
    theirs = fs.load_splats(splat_transform.converted(tmp_path / "a.spz", tmp_path / "b.ply"))
    assert_close(theirs, by_version(cloud))


@pytest.mark.parametrize("name", ["b.sog", "meta.json"])
def test_sog_is_read_and_written_by_both(tmp_path, name):
    cloud = thick(degree=2)
    fs.save_splats(cloud, tmp_path / "a.ply")
    (tmp_path / "theirs").mkdir()
    theirs = fs.load_splats(splat_transform.converted(tmp_path / "a.ply", tmp_path / "theirs" / name))
    order = np.abs(cloud.means[:, None] - theirs.means).sum(2).argmin(1)  # they sort
    wide = {"means": 1e-3, "scales": 0.05, "degrees": 1.3, "opacities": 0.0041, "dc": 0.1}
    scales = three_scales(theirs)[order]
    rows = (theirs.means[order], theirs.quats[order], scales, theirs.opacities[order])
    assert_close(fs.SplatCloud(*rows, sh=theirs.sh[order]), cloud, **wide)
    fs.save_splats(cloud, tmp_path / name)
    splat_transform.converted(tmp_path / name, tmp_path / "again.ply")
    again = fs.load_splats(tmp_path / "again.ply")
    assert_close(again, cloud, **wide)
    np.testing.assert_allclose(again.sh, fs.load_splats(tmp_path / name).sh, atol=1e-5)
