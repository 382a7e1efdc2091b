"""The test bench of tag detectors: causes, measurements, intervals and the command."""

import csv
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments.tag_causes import CAUSES, EDGES, view_of
from fidsplat.experiments.tags import begin_point, detectors_of, errors_of, load_detector
from fidsplat.experiments.tags_report import (
    bootstrap,
    breaking_severity,
    percentile,
    root_mean_square,
    wilson,
)
from fidsplat.scenes.lights import PointLight
from fidsplat.splats.rotations import quaternion_to_matrix

SMALL = ("--scene", "greenhouse", "--family", "apriltag:36h11", "--views", "2", "--severities", "1")


@pytest.fixture(scope="module")
def view():
    return view_of("greenhouse", "apriltag:36h11:5", "0")


def edge_pixels(view) -> float:
    corners = view.camera.project(view.placed.corners)
    return float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).mean())


def test_poses_depend_on_the_seed_and_not_on_the_family(view):
    again, other = (view_of("greenhouse", "aruco:4x4_50:7", seed) for seed in ("0", "1"))
    assert np.array_equal(again.camera.world_to_camera, view.camera.world_to_camera)
    assert not np.allclose(other.camera.world_to_camera, view.camera.world_to_camera)


@pytest.mark.parametrize("severity", [-0.1, 1.1, math.nan])
def test_a_severity_outside_of_0_to_1_is_refused(view, severity):
    with pytest.raises(fs.InputError, match="severity"):
        CAUSES["blur"].apply(view, severity)


def test_severity_0_is_the_view_without_a_cause(view):
    for name in ("distance", "opacity", "blur", "fog", "bright", "rolling", "defocus", "cylinder", "fading"):
        none = CAUSES[name].apply(view, 0.0)
        assert np.allclose(none.camera.world_to_camera, view.camera.world_to_camera), name
        assert none.camera.project(none.placed.corners) == pytest.approx(
            view.camera.project(view.placed.corners), abs=1e-6
        )
        assert np.allclose(none.placed.marker.cloud.opacities, view.placed.marker.cloud.opacities), name


def test_corners_that_coincide_are_not_read(view):
    assert errors_of(np.full((4, 2), 5.0), view) is None


def test_amounts_are_physical(view):
    far = CAUSES["distance"].apply(view, 1.0)
    assert edge_pixels(view) / edge_pixels(far) == pytest.approx(60 / EDGES, rel=0.1)
    tilted = CAUSES["angle"].apply(view, 1.0)
    towards = tilted.camera.position - tilted.placed.pose[:3, 3]
    cosine = -tilted.placed.pose[:3, 2] @ towards / np.linalg.norm(towards)
    assert math.degrees(math.acos(cosine)) == pytest.approx(85, abs=4)  # the aim is up to 4 degrees beside it
    # the marker moves by 32 pixels in a second, the exposure
    camera, blurred = view.camera, CAUSES["blur"].apply(view, 1.0).complete_capture
    before, after = (
        blurred.motion.moved(camera, time).project(view.placed.corners).mean(0) for time in (-0.5, 0.5)
    )
    assert np.linalg.norm(after - before) == pytest.approx(32, rel=0.2)  # edges of the image are further away
    assert blurred.shutter.exposure_time == 1.0
    hazy = CAUSES["fog"].apply(view, 1.0)
    distance = hazy.edges * hazy.placed.marker.size
    assert hazy.capture.fog is not None
    assert math.exp(-hazy.capture.fog.density * distance) == pytest.approx(0.01)


def test_a_cover_hides_its_share_of_the_code(view):
    cover = CAUSES["covered"].apply(view, 1.0).cover
    assert cover is not None
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * [*cover.scales[0], 0]
    corners = cover.means[0] + square @ quaternion_to_matrix(cover.quats[:1].astype(float))[0].T
    leaf, half = shapely.Polygon(corners[:, :2]), view.placed.marker.size / 2
    code = shapely.box(-half, -half, half, half)
    assert (leaf & code).area / code.area == pytest.approx(0.15, abs=0.02)


def test_planks_are_beside_the_marker_in_every_view():
    for number in range(12):
        shaded = CAUSES["shadow"].apply(view_of("greenhouse", "qr:a", f"{number}"), 1.0)
        assert shaded.cover is not None
        cloud, camera = shaded.cover.transformed(shaded.placed.pose), shaded.camera
        code = shapely.Polygon(camera.project(shaded.placed.corners)).buffer(20)
        square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        for middle, quat, scale in zip(cloud.world_means(), cloud.quats, cloud.scales, strict=True):
            corners = middle + square * [*scale, 0] @ quaternion_to_matrix(quat[None].astype(float))[0].T
            at = camera.project(corners)
            assert np.isnan(at).any() or not shapely.Polygon(at).intersects(code)  # NaN: behind the camera


def test_a_glaring_lamp_is_mirrored_within_the_code():
    for seed in "abc":
        view = CAUSES["glare"].apply(view_of("greenhouse", "apriltag:36h11:5", seed), 0.5)
        inverse, light = np.linalg.inv(view.placed.pose), view.lights[1]
        assert isinstance(light, PointLight)
        lamp, camera = (
            inverse[:3, :3] @ np.array(place) + inverse[:3, 3]
            for place in (light.position, view.camera.position)
        )
        # the mirror image of the lamp is behind the sheet; its ray crosses the sheet within the code
        image = lamp * (1, 1, -1)
        cross = camera + (image - camera) * camera[2] / (camera[2] - image[2])
        assert np.abs(cross[:2]).max() <= 0.26 * view.placed.marker.size


def test_detectors_agree_with_the_truth_without_a_cause(view):
    key = {"scene": "greenhouse", "family": "apriltag:36h11", "cause": "none", "severity": 0.0, "views": 2}
    key["detectors"] = list(detectors_of("apriltag:36h11"))
    actual = begin_point(key, fs.Renderer("opencl"), 0)()["errors"]
    limits = {"aruco": 2.0, "pupil": 0.3, "locus": 0.1, "fidsplat": 0.05}
    assert actual.keys() == limits.keys()
    for name, limit in limits.items():
        assert all(errors is not None and errors[0] < limit for errors in actual[name]), name


def test_errors_of_shifted_corners(view):
    corners = view.camera.project(view.placed.corners)
    assert errors_of(corners, view) == pytest.approx([0, 0, 0], abs=1e-3)
    pixels, degrees, percent = errors_of(corners + np.array([3.0, 4.0]), view) or (math.nan,) * 3
    assert pixels == pytest.approx(5.0)
    # 5 pixels of a focal length of 554: 0.9 % of the distance, mostly sideways
    assert percent == pytest.approx(0.9, abs=0.2)
    assert degrees < 2
    assert errors_of(None, view) is None


def test_intervals():
    # Newcombe 1998, table I: 81 of 263 and 15 of 148, 0 of 20
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    values = np.random.default_rng(0).normal(3.0, 1.0, 400)
    low, high = bootstrap(values, lambda chosen: chosen.mean(-1))
    error = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - error, values.mean() + error), abs=0.02)
    low, high = bootstrap(values, percentile(50))
    assert low < np.median(values) < high
    assert bootstrap(np.full(5, -2.0), root_mean_square) == (2.0, 2.0)
    assert all(map(math.isnan, bootstrap(np.zeros(0), percentile(99))))


def test_the_breaking_severity_is_interpolated():
    assert breaking_severity([0, 0.5, 1], [1.0, 0.75, 0.25]) == pytest.approx(0.75)
    assert breaking_severity([1, 0, 0.5], [0.0, 1.0, 1.0]) == pytest.approx(0.75)
    assert breaking_severity([0, 1], [1.0, 0.5]) is None
    assert breaking_severity([0, 1], [0.2, 0.0]) == 0


def run(capsys, *words) -> tuple[int, str, str]:
    status = main(["experiment", "tags", *map(str, words)])
    return status, *capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--cause", "blurr"), "did you mean 'blur'"),
        (("--detector", "arucoo"), "did you mean 'aruco'"),
        (("--detector", "missing_module:f"), "module:function"),
        (("--views", "0"), "--views"),
        (("--seed", "-1"), "--seed must be a whole number from 0"),
        (("--family", "qr", "--detector", "pupil"), "--detector must read one of qr"),
        (("--labels", "data", "--detector", "aruco"), "without options of measurements, got -o, --detector;"),
    ],
)
def test_wrong_options_are_one_line(capsys, tmp_path, words, expected):
    status, out, err = run(capsys, *words, "-o", tmp_path / "out")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert expected in err
    assert not (tmp_path / "out").exists()


def test_a_missing_package_is_named(capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "locus", None)
    status, _, err = run(capsys, "--detector", "locus", "-o", tmp_path / "out")
    assert status == 2
    assert "pip install locus-tag" in err


def test_a_failing_detector_of_the_user_is_named():
    with pytest.raises(fs.InputError, match=r"--detector math:sqrt must return pairs .*, got TypeError: "):
        load_detector("math:sqrt")(np.zeros((4, 4), np.uint8))


def test_own_detectors_shards_and_the_page(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_of_this_test.py").write_text(
        "calls = []\n"
        "def blind(grey):\n"
        "    calls.append(grey.shape)\n"
        "    grey[:] = 0  # in its own copy\n"
        "    return [('apriltag:36h11:9', [[0, 0], [9, 0], [9, 9], [0, 9]])]\n"
    )
    words = (*SMALL, "--cause", "distance", "--detector", "mine_of_this_test:blind", "--detector", "fidsplat")
    for number in (1, 2):
        assert run(capsys, *words, "--shard", f"{number}/2", "-o", "shards")[0] == 0
    assert main(["experiment", "merge", "shards", "-o", "joined"]) == 0
    import mine_of_this_test  # type: ignore[import-not-found]

    assert mine_of_this_test.calls == [(480, 640)] * 4
    capsys.readouterr()
    status, out, _ = run(capsys, *words, "-o", "joined", "--page", "page.md", "--json")
    assert (status, len(mine_of_this_test.calls)) == (0, 4)  # nothing is measured again
    (row,) = json.loads(out)["breaks"]
    assert row["mine_of_this_test:blind"] == "always"
    assert float(row["fidsplat"]) > 6
    page = (tmp_path / "page.md").read_text()
    assert "![" in page
    assert "experiment tags --severities 1 --views 2 --page" in page
    assert "2 points of scene, family, cause and severity with 2 views each are 4 images." in page
    assert "intervals of 2 views (p99 is nearly their maximum)." in page
    assert (tmp_path / "page" / "geometry.png").is_file()
    assert "corner_px_rms" in (tmp_path / "joined" / "tags.csv").read_text()
    lines = (tmp_path / "joined" / "tags.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    points = {(float(row["severity"]), row["amount"], row["images"]) for row in rows}
    assert points == {(0.0, "", "2"), (1.0, "60", "2")}


def test_labels_are_scenes_of_bop_with_coco(capsys, tmp_path):
    words = (*SMALL, "--cause", "distance", "--shard", "1/2", "--labels", tmp_path / "data", "--json")
    status, out, _ = run(capsys, *words)
    assert status == 0
    (folder,) = map(Path, json.loads(out)["folders"])
    coco = json.loads((folder / "coco.json").read_text())
    assert [image["file_name"] for image in coco["images"]] == ["rgb/000000.png", "rgb/000001.png"]
    view = view_of("greenhouse", "apriltag:36h11:5", "0 greenhouse 1")
    keypoints = np.reshape(coco["annotations"][1]["keypoints"], (4, 3))[:, :2]
    assert keypoints == pytest.approx(view.camera.project(view.placed.corners), abs=1e-6)
    poses = json.loads((folder / "scene_gt.json").read_text())["1"]
    true_pose = view.camera.world_to_camera @ view.placed.pose
    assert poses[0]["cam_t_m2c"] == pytest.approx(1000 * true_pose[:3, 3])
    written = (folder / "rgb" / "000000.png").stat().st_mtime_ns
    assert run(capsys, *words)[0] == 0
    assert (folder / "rgb" / "000000.png").stat().st_mtime_ns == written
    other = ["2/2" if word == "1/2" else word for word in words]  # the other point of the same folder
    (second,) = map(Path, json.loads(run(capsys, *other)[1])["folders"])
    points = [json.loads((place / "point.json").read_text()) for place in (folder, second)]
    assert points[1] == points[0] | {"cause": "distance", "severity": 1.0}
    status, _, err = run(capsys, *words, "--seed", "1")
    assert (status, err.count("\n")) == (2, 1)
    assert "got another one; repeat the earlier options" in err
