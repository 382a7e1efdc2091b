"""Boxes in clouds, markers and files."""

import json

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main


def cloud(n=4):
    means = np.arange(3 * n).reshape(n, 3)
    return fs.SplatCloud(means, np.ones((n, 4)), np.ones((n, 2)), np.ones(n), colors=np.ones((n, 3)))


def test_a_cloud_says_which_footprints_it_has():
    plain = cloud()
    assert (plain.boxes, plain.footprint) == (None, "gaussian")
    assert plain.with_boxes().footprint == "box"
    assert plain.with_boxes().with_boxes(False).boxes is None
    mixed = plain.with_boxes(np.array([True, False, False, True]))
    assert (mixed.footprint, mixed.boxes.tolist()) == ("mixed", [True, False, False, True])
    assert not mixed.boxes.flags.writeable
    moved = mixed.transformed(np.eye(4)).with_labels(3)
    assert np.array_equal(moved.boxes, mixed.boxes)


def test_joined_clouds_keep_their_footprints():
    joined = fs.SplatCloud.concatenate([cloud(2), cloud(1).with_boxes(), cloud(1)])
    assert joined.boxes.tolist() == [False, False, True, False]
    assert fs.SplatCloud.concatenate([cloud(2), cloud(1)]).boxes is None


@pytest.mark.parametrize("boxes", [1, [True], np.zeros(4), "box"])
def test_boxes_are_bools(boxes):
    with pytest.raises(fs.InputError, match="boxes must be"):
        cloud().with_boxes(boxes)


def test_a_coplanar_group_has_one_footprint():
    mask = np.array([True, False, True, False])
    with pytest.raises(fs.InputError, match="coplanar group 0 must have only boxes"):
        cloud().with_coplanar_groups(0).with_boxes(mask)
    with pytest.raises(fs.InputError, match="coplanar group 5 must have only boxes"):
        cloud().with_boxes(mask).with_coplanar_groups([1, -1, 5, 5])
    assert cloud().with_boxes(mask).with_coplanar_groups([1, 2, 1, -1]).has_coplanar_groups


def test_an_exact_marker_is_its_partition():
    marker = fs.marker("apriltag:36h11:5", size=0.16, mixture="exact")
    assert len(marker.cloud) == len(marker.rectangles)
    assert marker.cloud.footprint == "box"
    for rectangle, mean, scale, color in zip(
        marker.rectangles, marker.cloud.means, marker.cloud.scales, marker.cloud.colors, strict=True
    ):
        x0, x1 = (mean[0] + sign * scale[0] for sign in (-1, 1))
        y0, y1 = (mean[1] + sign * scale[1] for sign in (-1, 1))
        edges = np.array([x0, y0, x1, y1]) / marker.module + marker.grid.shape[0] / 2
        assert edges == pytest.approx(rectangle[:4], abs=1e-4)
        assert color.tolist() == [0.0 if rectangle.dark else 1.0] * 3
    assert (4 * marker.cloud.scales.prod(1)).sum() == pytest.approx((10 * 0.02) ** 2)


def test_an_exact_marker_has_gaussians_for_others():
    marker = fs.marker("qr:hello", mixture="exact")
    fitted = fs.marker("qr:hello", mixture="fitted")
    assert marker.gaussians.boxes is None
    assert np.array_equal(marker.gaussians.means, fitted.cloud.means)
    assert np.array_equal(marker.gaussians.opacities, fitted.cloud.opacities)
    assert fitted.gaussians is fitted.cloud


@pytest.mark.parametrize("option", [{"growth": 0.2}, {"levels": 3}])
def test_options_of_other_mixtures_are_refused(option):
    with pytest.raises(fs.InputError, match=next(iter(option))):
        fs.marker("qr:hello", mixture="exact", **option)


def test_a_ply_file_has_no_boxes(tmp_path):
    marker = fs.marker("apriltag:36h11:5", mixture="exact")
    with pytest.raises(fs.InputError, match=r"splats in a PLY file must be Gaussians, got \d+ boxes"):
        fs.save_ply(marker.cloud, tmp_path / "tag.ply")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_gaussians_and_says_so(tmp_path, capsys):
    file = tmp_path / "tag.ply"
    assert main(["marker", "apriltag:36h11:5", "--mixture", "exact", "-o", str(file)]) == 0
    assert "Gaussians (fitted), as a PLY file has no boxes" in " ".join(capsys.readouterr().out.split())
    again = ["-o", str(file), "--overwrite", "--json"]
    assert main(["marker", "apriltag:36h11:5", "--mixture", "exact", *again]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["mixture"], facts["written"]["mixture"]) == ("exact", "fitted")
    assert len(fs.load_ply(file)) == facts["written"]["splats"] > facts["splats"]


def test_a_scene_keeps_exact_markers(tmp_path):
    marker = fs.marker("apriltag:36h11:5", size=0.2, mixture="exact")
    scene = fs.Scene(markers=[fs.scenes.PlacedMarker(marker)])
    scene.save(tmp_path / "scene.toml")
    read = fs.Scene.load(tmp_path / "scene.toml")
    assert read.markers[0].marker.mixture == "exact"
    assert np.array_equal(read.cloud().boxes, marker.cloud.boxes)
