"""Bundles of markers on one rigid object: one pose from all detected markers."""

import json
from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import write_png
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision.bundles import read_bundles
from fidsplat.vision.detect import Detection
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.readback import Reading
from fidsplat.vision.truth import marker_truths

THING = rigid_matrix((0.1, -0.05, 1.2), (1, 0.1, 0.15, 0.05))
PARTS = (
    rigid_matrix((-0.15, 0, 0), (1, 0, 0.2, 0)),
    rigid_matrix((0.15, 0.02, 0.05), (1, 0, -0.25, 0)),
    rigid_matrix((0, -0.22, 0.1), (1, 0.2, 0, 0)),
)
PINHOLE = fs.Camera.pinhole(640, 480, 500, 500, 320, 240)


@pytest.fixture(scope="module")
def markers():
    tags = [fs.marker(f"apriltag:36h11:{k}", size=0.12) for k in range(4)]
    placed = [PlacedMarker(tags[k], THING @ part, bundle="box") for k, part in enumerate(PARTS)]
    return (*placed, PlacedMarker(tags[3], rigid_matrix((-0.35, 0.25, 1.5)), bundle="lid"))


def reading(placed, camera, noise=None):
    """Reading of a marker with corners that are off by an offset; None: not visible."""
    (expected,) = marker_truths([placed], camera)
    actual = Reading(placed, expected.truth, expected.corners, expected.visible, expected.box)
    code = Detection(
        "apriltag", "36h11", placed.marker.id, None, expected.corners + (0 if noise is None else noise)
    )
    return actual if noise is None else replace(actual, detection=code)


@pytest.mark.parametrize("camera", [PINHOLE, fs.Camera.fisheye(640, 480, 2.0)], ids=["pinhole", "fisheye"])
def test_exact_corners_give_the_exact_pose(markers, camera):
    seen = [reading(placed, camera, np.zeros((4, 2))) for placed in markers]
    box, lid = read_bundles([*seen[:2], replace(seen[2], detection=None), seen[3]], camera)
    assert (box.name, box.markers, box.found) == ("box", 3, 2)
    assert (lid.name, lid.markers, lid.found) == ("lid", 1, 1)
    np.testing.assert_allclose(box.truth, camera.world_to_camera @ markers[0].pose, atol=1e-12)
    assert box.position_error < 1e-6
    assert box.angle_error < 1e-6
    assert lid.position_error < 1e-6


def test_all_tags_together_say_more_than_one(markers):
    rng, errors = np.random.default_rng(0), []
    for _ in range(20):
        seen = [reading(placed, PINHOLE, rng.normal(0, 0.3, (4, 2))) for placed in markers[:3]]
        (box,) = read_bundles(seen, PINHOLE)
        alone = marker_pose(seen[0].detection.corners, 0.12, PINHOLE)
        errors.append([box.angle_error, pose_error(alone, seen[0].truth)[1]])
    together, one = np.mean(errors, axis=0)
    assert together < 0.5 * one


def test_a_bundle_of_which_nothing_is_visible_has_no_pose(markers):
    (box,) = read_bundles([reading(placed, PINHOLE) for placed in markers[:3]], PINHOLE)
    assert (box.found, box.pose, box.position_error) == (0, None, None)
    assert box.as_dict()["camera_from_bundle"] is None


def test_the_command_reads_bundles_of_a_scene_file(markers, tmp_path, capsys):
    scene = fs.Scene(camera=PINHOLE, markers=markers, background=(0.5,) * 3)
    scene.save(tmp_path / "scene.toml")
    again = fs.Scene.load(tmp_path / "scene.toml")
    assert [placed.bundle for placed in again.markers] == ["box", "box", "box", "lid"]
    write_png(tmp_path / "seen.png", fs.Renderer("opencl:pocl").render(scene)["rgb"])
    words = ["detect", str(tmp_path / "seen.png"), "--scene", str(tmp_path / "scene.toml")]
    assert main([*words, "--json"]) == 0
    box, lid = json.loads(capsys.readouterr().out)["bundles"]
    assert (box["bundle"], box["found"], lid["found"]) == ("box", 3, 1)
    assert box["position_error_mm"] < 1.0
    assert main(words) == 0
    assert "bundle box" in capsys.readouterr().out


@pytest.mark.parametrize("bundle", ["", 3])
def test_names_that_cannot_be(markers, bundle):
    with pytest.raises(fs.InputError, match=r"bundle must be a name"):
        PlacedMarker(markers[0].marker, bundle=bundle)
