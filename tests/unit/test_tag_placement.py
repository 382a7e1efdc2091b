"""Fisher information of tags against finite differences; selection against brute force; planned tags."""

import itertools
import json
import math
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from analytic_surfaces import plane
from command_line import fails, prints_json
from scipy.linalg import block_diag

import fidsplat as fs
from fidsplat.cameras.lenses import BrownConrady, Fisheye
from fidsplat.experiments import plan_tags as plans
from fidsplat.experiments.plan_tags import PlanSettings, plan_tags, sightings_of
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision.detect import detect
from fidsplat.vision.fisher_information import (
    CornerNoise,
    corner_covariances,
    pose_jacobian,
    tag_information,
)
from fidsplat.vision.tag_placement import (
    Sightings,
    error_gain,
    gain,
    greedy,
    local_search,
    odometry_covariance,
    planar_information,
    position_error,
    updated,
)

NOISE = CornerNoise(floor=0.01, noise=0.02)
LENSES = {"pinhole": None, "distorted": BrownConrady(k1=-0.1, p1=0.01), "fisheye": Fisheye(k1=0.02)}


def camera(lens=None) -> fs.Camera:
    pose = fs.Camera.look_at(8, 8, 1.0, (3.0, -2.0, 1.0), (3.2, -1.5, 4.0)).world_to_camera
    return fs.Camera.pinhole(320, 240, 300.0, 220.0, 150.0, 130.0, pose, lens=lens)


def moved(view: fs.Camera, axis: int, step: float) -> fs.Camera:
    """The camera after a small motion in its own axes: metres for axes 0 to 2, radians for 3 to 5."""
    delta = np.eye(4)
    if axis < 3:
        delta[axis, 3] = step
    else:
        quaternion = np.zeros(4)
        quaternion[0], quaternion[axis - 2] = math.cos(step / 2), math.sin(step / 2)
        delta = rigid_matrix((0, 0, 0), quaternion)
    return view.with_pose(np.linalg.inv(view.camera_to_world @ delta))


@pytest.mark.parametrize("lens", LENSES)
def test_the_jacobian_is_that_of_finite_differences(lens):
    view = camera(LENSES[lens])
    points = view.unproject(
        np.array([[40.0, 60.0], [200.0, 30.0], [160.0, 200.0]]), np.array([2.0, 1.0, 3.0])
    )
    actual, step = pose_jacobian(view, points), 1e-6
    for axis in range(6):
        ahead, behind = (moved(view, axis, s).project(points) for s in (step, -step))
        np.testing.assert_allclose(actual[:, :, axis], (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-4)


def test_the_variance_of_a_corner_is_that_of_fitted_edges():
    """Least squares of the offsets of an edge, whose information is integrated numerically."""
    side, blur, noise = 40.0, 0.8, CornerNoise(floor=1e-6, noise=0.03, contrast=0.7, blur=0.8)
    x = np.linspace(-8, 8, 4001)
    slope = 0.7 * np.exp(-((x / blur) ** 2) / 2) / (blur * math.sqrt(2 * math.pi))
    offset = 1 / (np.sum(slope**2) * (x[1] - x[0]) / 0.03**2)
    rows = np.stack([np.ones(4000), (np.arange(4000) + 0.5) / 4000], 1)
    at_end = np.linalg.inv(rows.T @ rows)[0, 0] * 4000 / side * offset
    square = np.array([[[10.0, 10.0], [50.0, 10.0], [50.0, 50.0], [10.0, 50.0]]])
    actual = corner_covariances(square, np.zeros_like(square), noise)
    np.testing.assert_allclose(actual, np.tile(at_end * np.eye(2), (1, 4, 1, 1)), rtol=2e-3, atol=1e-9)


def test_motion_blurs_the_edges_across_it():
    square = np.array([[[10.0, 10.0], [50.0, 10.0], [50.0, 50.0], [10.0, 50.0]]])
    along_x = np.broadcast_to([6.0, 0.0], square.shape)
    still, blurred = (corner_covariances(square, one, NOISE) for one in (np.zeros_like(square), along_x))
    np.testing.assert_allclose(blurred[..., 1, 1], still[..., 1, 1])
    factor = math.sqrt(0.5**2 + 6**2 / 12) / 0.5
    expected = (still[..., 0, 0] - 0.01**2) * factor + 0.01**2
    np.testing.assert_allclose(blurred[..., 0, 0], expected)


def test_information_predicts_the_error_of_the_pose():
    """Gauss-Newton on corners with noise of the model: the covariance of 400 poses is the inverse information
    (of 4 standard errors)."""
    view, rng = camera(), np.random.default_rng(0)
    half, pose = 0.1, view.camera_to_world @ rigid_matrix((0.1, -0.05, 0.8), (0.9, 0.3, 0.25, 0.1))
    square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    corners = square @ pose[:3, :3].T + pose[:3, 3]
    information = tag_information(view, corners[None], NOISE)[0]
    pixels = view.project(corners)
    covariance = corner_covariances(pixels[None], np.zeros((1, 4, 2)), NOISE)[0]
    jacobian = pose_jacobian(view, corners).reshape(8, 6)
    weight = block_diag(*np.linalg.inv(covariance))
    roots = np.linalg.cholesky(covariance)
    errors = []
    for _ in range(400):
        off = np.einsum("cij,cj->ci", roots, rng.normal(size=(4, 2))).ravel()
        errors.append(np.linalg.solve(jacobian.T @ weight @ jacobian, jacobian.T @ weight @ off))
    whitened = np.linalg.cholesky(information).T @ np.array(errors).T
    assert np.mean((whitened**2).sum(0)) == pytest.approx(6.0, abs=4 * math.sqrt(12 / 400))


def test_odometry_drifts_as_in_the_closed_form():
    """Straight ahead: the error aside is the sum of the steps' errors and of those of the heading."""
    count, metres, radians = 6, 0.02, 0.01
    poses = np.tile(np.eye(4), (count + 1, 1, 1))
    poses[:, 2, 3] = np.arange(count + 1)
    actual = odometry_covariance(poses, metres, radians, (0.0, 0.0))[-6:, -6:]
    aside = count * metres**2 + radians**2 * sum(m * m for m in range(count))
    np.testing.assert_allclose(
        np.diag(actual), [aside, aside, count * metres**2, *[count * radians**2] * 3], rtol=1e-5
    )
    assert position_error(actual) == pytest.approx(math.sqrt(2 * aside + count * metres**2), rel=1e-5)


def test_a_camera_on_a_floor_drifts_in_the_plane():
    """With y vertical: x, z and the rotation about y as in space, the others not at all."""
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 2, 3] = np.arange(4)
    up = np.array([0.0, -2.0, 0.0])
    space, floor = (odometry_covariance(poses, 0.02, 0.01, up=one)[-6:, -6:] for one in (None, up))
    np.testing.assert_allclose(np.diag(floor), np.diag(space) * [1, 0, 1, 0, 1, 0], atol=1e-18)


def test_errors_of_height_and_tilt_are_marginalised():
    rng = np.random.default_rng(0)
    poses = np.array([camera().camera_to_world, np.eye(4)])
    roots = rng.normal(size=(2, 6, 6)) * 300
    information = roots @ roots.transpose(0, 2, 1)
    up = np.array([0.3, -1.0, 0.2])
    actual = planar_information(information, poses, up)
    for own, pose, result in zip(information, poses, actual, strict=True):
        vertical = pose[:3, :3].T @ up / np.linalg.norm(up)
        along = np.outer(vertical, vertical)
        errors = block_diag(0.003**2 * along, 0.005**2 * (np.eye(3) - along))
        np.testing.assert_allclose(result, np.linalg.inv(np.linalg.inv(own) + errors), rtol=1e-6, atol=1e-6)


def problem(seed: int, count: int = 8, poses: int = 4):
    rng = np.random.default_rng(seed)
    path = np.tile(np.eye(4), (poses, 1, 1))
    path[:, 2, 3] = np.arange(poses)
    candidates = []
    for _ in range(count):
        seen = np.sort(rng.choice(poses, rng.integers(1, poses), replace=False))
        roots = rng.normal(size=(len(seen), 6, 6)) * 10.0 ** rng.uniform(1, 2.5)
        roots[:, :, int(rng.integers(3, 7)) :] = 0.0
        candidates.append(Sightings(seen, roots @ roots.transpose(0, 2, 1)))
    return odometry_covariance(path, 0.02, 0.02), candidates


def value_of(covariance, candidates, chosen) -> float:
    """The log determinant of the sum of all information, densely."""
    before = np.linalg.inv(covariance)
    after = before.copy()
    for one in (candidates[k] for k in chosen):
        for pose, information in zip(one.poses, one.information, strict=True):
            rows = slice(6 * pose, 6 * pose + 6)
            after[rows, rows] += information
    return np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]


def test_updates_are_those_of_dense_matrices():
    covariance, candidates = problem(0)
    first, second = candidates[:2]
    assert gain(covariance, first) == pytest.approx(value_of(covariance, candidates, [0]))
    after = updated(covariance, first)
    assert gain(after, second) == pytest.approx(
        value_of(covariance, candidates, [0, 1]) - gain(covariance, first)
    )
    dense = np.linalg.inv(covariance)
    for pose, information in zip(first.poses, first.information, strict=True):
        dense[6 * pose : 6 * pose + 6, 6 * pose : 6 * pose + 6] += information
    np.testing.assert_allclose(after, np.linalg.inv(dense), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_selections_against_brute_force(seed):
    covariance, candidates = problem(seed)
    best = max(value_of(covariance, candidates, some) for some in itertools.combinations(range(8), 3))
    selection = greedy(covariance, candidates, 3)
    assert selection.value == pytest.approx(value_of(covariance, candidates, selection.chosen))
    assert (1 - 1 / math.e) * best <= selection.value <= best * (1 + 1e-9)
    assert selection.bound >= best * (1 - 1e-9)
    searched = local_search(covariance, candidates, selection)
    assert searched.value == pytest.approx(value_of(covariance, candidates, searched.chosen))
    assert searched.value == pytest.approx(best)
    worst = min(itertools.combinations(range(8), 3), key=lambda some: value_of(covariance, candidates, some))
    start = selection.__class__(worst, value_of(covariance, candidates, worst), math.inf)
    assert local_search(covariance, candidates, start).value == pytest.approx(best)


def error_of(covariance, candidates, chosen) -> float:
    for k in chosen:
        covariance = updated(covariance, candidates[k])
    return position_error(covariance)


def test_the_predicted_error_can_be_minimised():
    """Exchanges reach the best of all selections; greedy selection alone does not in all of them."""
    short = 0
    for seed in range(6):
        covariance, candidates = problem(seed)
        best = min(error_of(covariance, candidates, some) for some in itertools.combinations(range(8), 3))
        selection = greedy(covariance, candidates, 3, objective=error_gain)
        decrease = position_error(covariance) ** 2 - error_of(covariance, candidates, selection.chosen) ** 2
        assert selection.value == pytest.approx(decrease)
        assert math.isinf(selection.bound)
        short += error_of(covariance, candidates, selection.chosen) > best * (1 + 1e-9)
        searched = local_search(covariance, candidates, selection, objective=error_gain)
        assert error_of(covariance, candidates, searched.chosen) == pytest.approx(best)
    assert short < 6


def test_exchanges_of_precise_tags_lose_no_digits():
    """After much drift, tags of high information determine nearly everything."""
    rng, path = np.random.default_rng(1), np.tile(np.eye(4), (30, 1, 1))
    path[:, 0, 3] = np.arange(30) / 2
    covariance, candidates = odometry_covariance(path, 1.0, 0.5, start=(1.0, 1.0)), []
    for _ in range(40):
        roots = 1e4 * rng.normal(size=(5, 6, 8))
        seen = np.sort(rng.choice(30, 5, replace=False))
        candidates.append(Sightings(seen, roots @ roots.transpose(0, 2, 1)))
    selection = greedy(covariance, candidates, 6, objective=error_gain)
    searched = local_search(covariance, candidates, selection, objective=error_gain)
    left = error_of(covariance, candidates, searched.chosen)
    assert position_error(covariance) ** 2 - searched.value == pytest.approx(left**2, rel=1e-3)
    assert left <= error_of(covariance, candidates, selection.chosen)


def test_conflicts_and_targets_are_respected():
    covariance, candidates = problem(1)
    free = greedy(covariance, candidates, 3).chosen
    conflicts = np.zeros((8, 8), bool)
    conflicts[free[0], free[1]] = conflicts[free[1], free[0]] = True
    selection = greedy(covariance, candidates, 3, conflicts)
    assert not {free[0], free[1]} <= set(selection.chosen)
    assert not {free[0], free[1]} <= set(local_search(covariance, candidates, selection, conflicts).chosen)
    target = position_error(updated(covariance, candidates[free[0]])) * 1.0001
    assert (
        greedy(covariance, candidates, 8, None, lambda now: position_error(now) <= target).chosen == free[:1]
    )


def test_tags_are_seen_where_they_are_readable():
    """In front, behind an occluder, from behind, too far, too oblique, cut by the edge of the image."""
    view = fs.Camera.look_at(320, 240, 1.2, (0, 0, 0), (0, 0, 1))
    tag = fs.marker("apriltag:36h11:0", 0.3)
    turned = (math.cos(math.radians(37.5)), 0, math.sin(math.radians(37.5)), 0)
    poses = {
        "in front": rigid_matrix((-0.3, 0, 1.5)),
        "occluded": rigid_matrix((0.5, 0, 1.5)),
        "from behind": rigid_matrix((-0.3, 0, 1.5), (0, 1, 0, 0)),
        "far": rigid_matrix((0, 0, 30.0)),
        "oblique": rigid_matrix((-0.3, 0, 1.5), turned),
        "cut": rigid_matrix((1.0, 0, 1.5)),
    }
    depth = np.zeros((240, 320), np.float32)
    depth[:, 200:240] = 1.0
    actual = sightings_of([PlacedMarker(tag, pose) for pose in poses.values()], [view], [depth], NOISE)
    assert {name for name, one in zip(poses, actual, strict=True) if len(one.poses)} == {"in front"}
    placed = PlacedMarker(tag, poses["in front"])
    np.testing.assert_allclose(actual[0].information, tag_information(view, placed.corners[None], NOISE))


@pytest.fixture
def few_candidates(monkeypatch):
    monkeypatch.setattr(plans, "STEPS", 6)
    monkeypatch.setattr(plans, "ROWS", 4)


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """A wall along a path of 4 m; the camera looks at it obliquely."""
    folder = tmp_path_factory.mktemp("hall")
    wall = plane(np.array([0.0, 0.0, 1.5]), (0.0, 0.0, -1.0), 3.0, 0.15)
    scene = fs.Scene([wall], camera=fs.Camera.look_at(160, 120, 1.2, (0, 0, 0), (0, 0, 1)))
    scene.save(folder / "scene.toml")
    poses = np.array(
        [fs.Camera.look_at(8, 8, 1, (x, 0, 0), (x + 0.5, 0, 1)).camera_to_world for x in (-2, -1, 0, 1, 2)]
    )
    fs.save_trajectory(fs.Trajectory(range(5), poses), folder / "path.tum")
    return folder


def test_planned_tags_are_detected_where_the_plan_says(hall, few_candidates):
    renderer, path = fs.Renderer("opencl"), fs.load_trajectory(hall / "path.tum")
    scene = fs.Scene.load(hall / "scene.toml")
    settings = PlanSettings(count=3, size=0.4, poses=5, views=5)
    plan = plan_tags(scene, path, settings, renderer)
    assert len(plan.tags) == 3
    assert [tag.marker.id for tag in plan.tags] == [0, 1, 2]
    assert list(plan.errors) == sorted(plan.errors, reverse=True)
    assert plan.errors[-1] < 0.5 * plan.errors[0]
    for tag in plan.tags:
        np.testing.assert_allclose(-tag.pose[:3, 2], (0, 0, -1), atol=1e-3)
        assert 1.49 < tag.pose[2, 3] < 1.5
    seen = [0, 0, 0]
    for pose in plan.path:
        image = renderer.render(plan.scene, scene.camera.with_pose(camera_to_world=pose).with_size(320, 240))
        for code in detect(image.to_uint8(), ("apriltag:36h11",), qr=False):
            seen[code.id] += 1
    assert all(detected >= planned for detected, planned in zip(seen, plan.sightings, strict=True))
    settings = PlanSettings(count=1, size=0.4, family="tag36h11", poses=5, views=5)
    again = plan_tags(plan.scene, path, settings, renderer)
    assert again.tags[0].marker.id == 3  # its own tags count, and keep their ids
    apart = [np.linalg.norm(again.tags[0].pose[:3, 3] - tag.pose[:3, 3]) for tag in plan.tags]
    assert min(apart) > 0.4 * 1.25 * math.sqrt(2)
    assert again.errors[0] == pytest.approx(plan.errors[-1], rel=0.05)


def test_the_command_writes_a_scene_and_a_map(hall, few_candidates, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="the extra experiments is not installed")
    words = ["plan-tags", hall / "scene.toml", "--trajectory", hall / "path.tum", "--size", "0.4"]
    words += ["--poses", "5", "--views", "3", "--count", "2", "-o", tmp_path / "plan"]
    facts = prints_json(capsys, *words)
    scene = fs.Scene.load(tmp_path / "plan/scene.toml")
    assert [tag.marker.spec for tag in scene.markers] == [tag["spec"] for tag in facts["tags"]]
    assert 0 < facts["objective"] <= facts["bound"]
    assert (tmp_path / "plan/map.svg").read_text().count("<svg") == 1
    assert "already exists" in fails(capsys, *words)[1]


def test_the_example_plans_tags_in_an_aisle(few_candidates, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib", reason="the extra experiments is not installed")
    example = Path(__file__).resolve().parents[2] / "examples" / "plan_tags.py"
    arguments = ["--count", "2", "--poses", "9", "-o", str(tmp_path / "plan")]
    monkeypatch.setattr(sys, "argv", [str(example), *arguments])
    runpy.run_path(str(example), run_name="__main__")
    facts = json.loads((tmp_path / "plan/plan.json").read_text())
    assert len(facts["tags"]) == 2
    assert facts["error_m"] < 0.5 * facts["error_without_m"]
    assert f"{facts['error_m']:.4f} m with them" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--count", "0"], "--count must be at least 1"),
        (["--size", "0.01"], "give larger tags, --size 0."),
        (["--count", "31", "--family", "tag16h5"], "--count must be at most 30, the free ids of 16h5"),
        (["--size", "-1"], "--size must be above 0"),
        (["--target", "0"], "--target must be a positive length"),
        (["--size", "9"], "got none; give smaller tags"),
    ],
)
def test_impossible_plans_are_reported(hall, few_candidates, tmp_path, capsys, words, message):
    arguments = ["plan-tags", hall / "scene.toml", "--trajectory", hall / "path.tum", "-o", tmp_path / "p"]
    assert message in fails(capsys, *arguments, "--poses", "5", *words)[1]


def test_a_folder_that_cannot_be_written_is_reported_before_the_search(hall, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("fidsplat.experiments.plan_tags.plan_tags", None)  # not called
    (tmp_path / "file").touch()
    arguments = ["plan-tags", hall / "scene.toml", "--trajectory", hall / "path.tum"]
    assert "cannot write into the folder" in fails(capsys, *arguments, "-o", tmp_path / "file" / "p")[1]


def test_a_missing_trajectory_leaves_no_folder(hall, tmp_path, capsys):
    arguments = ["plan-tags", hall / "scene.toml", "--trajectory", tmp_path / "no.tum", "-o", tmp_path / "p"]
    assert "no.tum" in fails(capsys, *arguments)[1]
    assert not (tmp_path / "p").exists()
