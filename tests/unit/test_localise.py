"""The robot, its filter, and `fidsplat experiment localise`."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.sim.localiser import Localiser
from fidsplat.splats.rotations import rigid_matrix

mujoco = pytest.importorskip("mujoco", reason="pip install 'fidsplat[sim]'")

from fidsplat.experiments.localise import (  # noqa: E402 (needs MuJoCo)
    VARIANTS,
    Drive,
    Variant,
    errors_of,
    record,
    recorded,
    write_log,
)
from fidsplat.experiments.localise_sweep import write_report  # noqa: E402
from fidsplat.worlds.greenhouse import Greenhouse  # noqa: E402
from fidsplat.worlds.robot import (  # noqa: E402
    BODY,
    CAMERA_AT,
    CONTROL,
    Errors,
    Run,
    _measured,
    camera_at,
    drive,
    mount,
)

EXACT = Errors(wheels=0, slip=0, gyro_bias=0, gyro_noise=0)
CAMERA = fs.Camera.look_at(320, 240, 1.2, (0, 0, 0), (0, 0, 1))


@pytest.fixture(scope="module")
def house():
    return Greenhouse(1, 3)


@pytest.fixture(scope="module")
def run(house):
    return drive(house.mjcf(BODY), np.array([[-0.5, -0.75], [1.0, -0.75], [1.0, -1.5]]), errors=EXACT)


def headed(heading, x=0.0, y=0.0):
    return rigid_matrix((x, y, 0), (math.cos(heading / 2), 0, 0, math.sin(heading / 2)))


def test_the_robot_follows_its_path_and_stays_upright(run):
    assert run.length == pytest.approx(2.25, abs=0.05)
    np.testing.assert_allclose(run.poses[-1, :2, 3], [1.0, -1.5], atol=0.03)
    assert np.abs(run.poses[:, 2, 3]).max() < 0.005
    assert np.abs(run.poses[:, 2, :2]).max() < 0.02


def test_wheels_and_gyroscope_without_errors_say_where_it_is(run):
    filtered = Localiser(np.array([-0.5, -0.75, 0.0]))
    for k in range(1, len(run.times)):
        filtered.move(run.wheels[k], run.gyro[k], run.times[k] - run.times[k - 1])
    assert np.linalg.norm(filtered.pose[:2, 3] - run.poses[-1, :2, 3]) < 0.03
    heading = math.atan2(run.poses[-1, 1, 0], run.poses[-1, 0, 0])
    assert filtered.state[2] == pytest.approx(heading, abs=0.02)


def test_errors_of_sensors_are_the_seeds(house):
    path = np.array([[-0.5, -0.75], [0.0, -0.75]])
    one, same, other = (drive(house.mjcf(BODY), path, errors=Errors(seed=s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.wheels, same.wheels)
    np.testing.assert_array_equal(one.poses, other.poses)
    assert not np.array_equal(one.wheels, other.wheels)
    assert one.gyro.std() == pytest.approx(0.002, abs=0.01)


def test_a_wheel_slips_by_the_metre_whatever_the_step():
    """Its distance after d metres is off by slip * sqrt(d), of small steps as of large ones."""
    slip = 0.05
    for steps, step in ((4000, 0.01), (4000, 0.25)):
        rolled = step * np.arange(steps)[:, None] * np.array([1.0, -1.0])  # the right wheel rolls back
        times, poses = np.arange(steps) * CONTROL, np.tile(np.eye(4), (steps, 1, 1))
        odometry = _measured(times, poses, rolled, np.zeros(steps), replace(EXACT, slip=slip))
        off = odometry.wheels - np.diff(rolled, axis=0, prepend=rolled[:1])
        assert off[0].tolist() == [0.0, 0.0]  # what has not rolled does not slip
        assert off[1:].std(axis=0) == pytest.approx([slip * math.sqrt(step)] * 2, rel=0.05)
        assert off.sum(axis=0) == pytest.approx([0, 0], abs=4 * slip * math.sqrt(steps * step))


def test_the_filter_doubts_its_wheels_by_the_metre():
    """3 mm after a metre ahead and aside, in one step or in a hundred, forwards or back; nothing at rest."""
    spreads = []
    for steps, step in ((100, 0.01), (1, 1.0), (1, -1.0)):
        filtered = Localiser(np.zeros(3))
        filtered.covariance = np.zeros((5, 5))
        for _ in range(steps):
            filtered.move(np.full(2, step), 0.0, 0.0)
        spreads.append(filtered.covariance.copy())
        assert filtered.state[0] == pytest.approx(steps * step)
    for spread in spreads:
        assert math.sqrt(spread[0, 0]) == pytest.approx(0.003, rel=0.01)
        assert math.sqrt(spread[2, 2]) == pytest.approx(1e-3, rel=0.01)
    resting = Localiser(np.zeros(3))
    before = np.diag(resting.covariance)[:2].copy()
    resting.move(np.zeros(2), 0.0, 0.02)
    np.testing.assert_array_equal(np.diag(resting.covariance)[:2], before)


def test_a_robot_that_meets_a_bench_says_so(house):
    with pytest.raises(fs.InputError, match="got stuck at"):
        drive(house.mjcf(BODY), np.array([[0.9, -0.9], [0.9, 0.9]]), speed=3.0)
    with pytest.raises(fs.InputError, match="two or more corners"):
        drive(house.mjcf(BODY), np.zeros((1, 2)))


def test_the_camera_looks_ahead():
    camera = camera_at(CAMERA, headed(math.pi / 2, 1.0, 2.0))
    np.testing.assert_allclose(camera.position, [1.0, 2.0 + CAMERA_AT[0], CAMERA_AT[2]], atol=1e-12)
    np.testing.assert_allclose(camera.project([[1.0, 5.0, CAMERA_AT[2]]]), [[160, 120]], atol=1e-9)
    (x, y) = camera.project([[0.5, 5.0, 1.0]])[0]
    assert x < 160  # what lies to the left, higher
    assert y < 120
    assert mount()[:3, 2] @ [1, 0, 0] == pytest.approx(1)


def test_a_tag_takes_the_error_away_and_one_elsewhere_is_not_believed():
    far = np.array([[2.0, 0.3, 0.5], [2.0, 0.1, 0.5], [2.0, 0.1, 0.3], [2.0, 0.3, 0.3]])
    near = far * [0.5, 1.0, 1.0] + [0.0, -0.5, 0.0]

    def standing(pose):
        return camera_at(CAMERA, pose)

    filtered = Localiser(np.array([0.02, -0.02, 0.01]))
    filtered.covariance[:3, :3] = np.diag([0.03, 0.03, 0.02]) ** 2
    for _ in range(30):
        for tag in (far, near):
            assert filtered.correct(standing(np.eye(4)).project(tag), tag, standing)
    assert np.abs(filtered.state[:2]).max() < 0.005
    assert abs(filtered.state[2]) < 0.002
    assert np.sqrt(np.diag(filtered.covariance)[:2]).max() < 0.02
    before = filtered.state.copy()
    assert not filtered.correct(standing(np.eye(4)).project(far) + 60, far, standing)
    np.testing.assert_array_equal(filtered.state, before)
    assert filtered.rejected == 1


def test_a_tag_behind_the_robot_is_not_believed():
    tag = np.array([[-2.0, 0.3, 0.5], [-2.0, 0.1, 0.5], [-2.0, 0.1, 0.3], [-2.0, 0.3, 0.3]])
    filtered = Localiser(np.zeros(3))
    assert not filtered.correct(np.full((4, 2), 100.0), tag, lambda pose: camera_at(CAMERA, pose))


@pytest.mark.parametrize("bad", ["corner", "derivative", "tilt"])
def test_one_number_that_is_not_finite_changes_nothing(bad):
    """Of the corners, or of the images of a camera that moved or is tilted."""
    tag = np.array([[2.0, 0.3, 0.5], [2.0, 0.1, 0.5], [2.0, 0.1, 0.3], [2.0, 0.3, 0.3]])
    filtered, calls = Localiser(np.zeros(3)), []
    corners = camera_at(CAMERA, np.eye(4)).project(tag)
    wrong = {"corner": 0, "derivative": 2, "tilt": 5}[bad]  # number of the call

    class Camera:
        def project(self, points):
            calls.append(points)
            return np.full((4, 2), np.nan) if len(calls) == wrong else corners + 0.1

    if bad == "corner":
        corners = corners.copy()
        corners[2, 1] = np.nan
        assert not filtered.correct(corners, tag, lambda pose: camera_at(CAMERA, pose))
    else:
        assert not filtered.correct(corners, tag, lambda pose: Camera())
    np.testing.assert_array_equal(filtered.state, [0, 0, 0, 0, 1])
    assert filtered.rejected == 0


def test_a_match_of_scans_corrects_the_motion_and_not_the_place():
    """Wheels slip by a tenth; a scan measures the motion since its reference, not the place."""
    filtered = Localiser(np.array([1.0, 2.0, 0.5]), drift=0.2)
    filtered.covariance[:3, :3] = np.diag([0.3, 0.2, 0.1]) ** 2
    before = filtered.covariance[:3, :3].copy()
    filtered.set_reference()
    for _ in range(50):
        filtered.move(np.full(2, 0.022), 0.22, 0.02)
    true = headed(0.2, 0.98, 0.1)
    assert np.linalg.norm(filtered.relative[:2, 3] - true[:2, 3]) > 0.05
    assert filtered.match(np.array([0.98, 0.1, 0.2]), np.diag([1e-4, 1e-4, 1e-4]) ** 2)
    np.testing.assert_allclose(filtered.relative, true, atol=1e-3)
    np.testing.assert_allclose(filtered.covariance[5:, 5:], before, rtol=0.02, atol=1e-9)
    assert not filtered.match(np.array([2.0, 0.1, 0.2]), np.diag([1e-4, 1e-4, 1e-4]) ** 2)
    assert filtered.rejected == 1


def test_matches_with_one_reference_share_its_error():
    """Against the closed form: n scans do not average away the error of their reference."""
    filtered, noise = Localiser(np.array([1.0, 2.0, 0.7])), np.diag([0.02, 0.01, 0.005]) ** 2
    filtered.covariance[:3, :3] = 1e-14 * np.eye(3)
    filtered.set_reference()
    filtered.covariance[:3, :3] = np.eye(3)  # moved without any knowledge
    for _ in range(10):
        assert filtered.match(np.zeros(3), noise)
    turn = headed(0.7, 0, 0)[:3, :3]
    expected = turn @ noise @ turn.T / 2 * (1 + 1 / 10)
    np.testing.assert_allclose(filtered.covariance[:3, :3], expected, rtol=1e-3, atol=1e-9)


def test_scans_of_a_room_give_the_motion():
    """Against the closed form: corners of a room, from two places; then a turn too far for the old
    reference."""
    matching = pytest.importorskip("fidsplat.sim.scan_matching", reason="pip install 'fidsplat[sim]'")
    rng = np.random.default_rng(0)
    wall = np.stack([np.full(4000, 3.0), rng.uniform(-2, 2, 4000), rng.uniform(-1, 1, 4000)], 1)
    side = np.stack([rng.uniform(-3, 3, 4000), np.full(4000, 2.0), rng.uniform(-1, 1, 4000)], 1)
    floor = np.stack([rng.uniform(-3, 3, 4000), rng.uniform(-2, 2, 4000), np.full(4000, -1.0)], 1)
    room = np.concatenate([wall, side, floor, wall * [-1, 1, 1], side * [1, -1, 1]])

    def seen(pose):
        return (room - pose[:3, 3]) @ pose[:3, :3] + rng.normal(0, 0.005, room.shape)

    filtered, matcher = Localiser(np.zeros(3), drift=0.1), matching.ScanMatcher(0.7)
    for few in (room[:0], room[:1], np.full((30, 3), np.nan)):  # as in an empty hall
        assert not matcher.correct(filtered, few)
    assert not matcher.correct(filtered, seen(np.eye(4)))  # the reference
    filtered.move(np.full(2, 0.15), 0.41, 0.25)
    assert matcher.correct(filtered, seen(headed(0.1, 0.2, 0.05)))
    np.testing.assert_allclose(filtered.pose, headed(0.1, 0.2, 0.05), atol=0.012)
    np.testing.assert_allclose(filtered.relative, filtered.pose, atol=2e-3)  # still of the first scan
    filtered.move(np.zeros(2), 2.4, 0.25)
    matcher.correct(filtered, seen(headed(0.7, 0.2, 0.05)))
    np.testing.assert_allclose(filtered.relative, np.eye(4), atol=1e-12)

    # a corridor: a scan measures the way across, not along
    room = np.concatenate([side, side * [1, -1, 1], floor])
    filtered, matcher = Localiser(np.zeros(3), drift=0.2), matching.ScanMatcher(0.7)
    matcher.correct(filtered, seen(np.eye(4)))
    filtered.move(np.full(2, 0.2), 0.0, 0.25)
    before = np.sqrt(np.diag(filtered.covariance))
    assert matcher.correct(filtered, seen(headed(0.0, 0.15, 0.05)))
    np.testing.assert_allclose(filtered.pose[1, 3], 0.05, atol=0.012)
    along, across = (np.sqrt(np.diag(filtered.covariance)) / before)[:2]
    assert across < 0.2 < 0.95 < along


def test_errors_are_those_of_evo():
    times = np.linspace(0, 10, 400)
    expected = np.array([headed(0.1 * t, 0.5 * t, math.sin(t)) for t in times])
    rng = np.random.default_rng(0)
    guess = expected @ np.array(
        [headed(a, *b) for a, b in zip(rng.normal(0, 0.02, 400), rng.normal(0, 0.05, (400, 2)), strict=True)]
    )
    actual = errors_of(Run(times, expected, np.zeros((400, 2)), np.zeros(400)), guess)
    assert actual["heading_deg"] == pytest.approx(math.degrees(0.02), rel=0.15)
    metrics = pytest.importorskip("evo.core.metrics", reason="pip install evo")
    from evo.core.trajectory import PoseTrajectory3D

    pair = [PoseTrajectory3D(poses_se3=list(poses), timestamps=times) for poses in (expected, guess)]
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    assert actual["ate_m"] == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse))
    assert actual["worst_m"] == pytest.approx(ape.get_statistic(metrics.StatisticsType.max))
    rpe = metrics.RPE(metrics.PoseRelation.translation_part, 1.0, metrics.Unit.meters, all_pairs=True)
    rpe.process_data(pair)
    assert actual["rpe_m"] == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=0.2)


def test_the_command_measures_once(tmp_path, monkeypatch, capsys):
    """Odometry alone, which renders nothing."""
    monkeypatch.setenv("FIDSPLAT_DEVICE", "reference")
    words = ["experiment", "localise", "--quick", "-o", str(tmp_path / "out"), "--variant", "odometry"]
    assert main([*words, "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["variants"]["odometry"]["ate_m"] > 0.02
    assert 9 < first["variants"]["odometry"]["length_m"] < 10
    expected = fs.load_trajectory(tmp_path / "out/truth.tum")
    guess = fs.load_trajectory(tmp_path / "out/odometry.tum")
    off = np.linalg.norm(expected.poses[:, :2, 3] - guess.poses[:, :2, 3], axis=1)
    ate = first["variants"]["odometry"]["ate_m"]  # to six digits
    assert np.sqrt((off**2).mean()) == pytest.approx(
        ate, rel=1e-6, abs=0.5e-6 * 10 ** math.ceil(math.log10(ate))
    )
    monkeypatch.setattr(Drive, "run", lambda self, speed=None: pytest.fail("measured again"))
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert "<svg" in (tmp_path / "out/localise.svg").read_text()
    assert "| odometry |" in (tmp_path / "out/localise.md").read_text()
    assert main([*words, "--seed", "1"]) == 2
    assert "localise.jsonl must be of the same seed" in capsys.readouterr().err
    whole = [word for word in words if word != "--quick"]
    assert main([*whole, "--rows", "1", "--plants", "3"]) == 2
    assert "localise.jsonl must be of the same scene" in capsys.readouterr().err
    assert main([*words[:-1], "odometri"]) == 2
    error_output = capsys.readouterr().err
    assert "unknown variant 'odometri' (did you mean 'odometry'?)" in error_output
    assert ", all of these, '0.25 m/s, blur', '1 m/s, blur', up to 1 m, " in error_output
    file = tmp_path / "out/localise.jsonl"
    file.write_text(file.read_text().replace(first["run"]["code"], "yesterday's"))
    assert main(words) == 2
    assert "localise.jsonl must be of the same code" in capsys.readouterr().err
    file.write_text("[]\n")
    assert main(words) == 2
    assert "localise.jsonl, line 1: not a result" in capsys.readouterr().err


def test_the_drive_as_a_log(tmp_path, monkeypatch):
    reader = pytest.importorskip("mcap.reader", reason="pip install 'fidsplat[logs]'")
    monkeypatch.setattr("fidsplat.experiments.localise.RATE", 0.5)
    grey = np.full((480, 640, 3), 128, np.uint8)
    monkeypatch.setattr(
        Drive, "images", lambda self, variant, run, renderer: (grey for _ in self.image_indices(run))
    )
    requested = Drive(1, 1)
    images = list(write_log(requested, "exact", None, str(tmp_path / "run.mcap"), False))
    with (tmp_path / "run.mcap").open("rb") as stream:
        counts = reader.make_reader(stream).get_summary().statistics.channel_message_counts
        stream.seek(0)
        topics = {k: each.topic for k, each in reader.make_reader(stream).get_summary().channels.items()}
    counts = {topics[k]: count for k, count in counts.items()}
    ros2 = pytest.importorskip("mcap_ros2.decoder", reason="pip install mcap-ros2-support")
    with (tmp_path / "run.mcap").open("rb") as stream:
        log = reader.make_reader(stream, decoder_factories=[ros2.DecoderFactory()])
        turned = next(log.iter_decoded_messages(topics=["/imu/data_raw"]))[-1]
    assert turned.linear_acceleration_covariance[0] == -1  # no accelerometer
    assert (
        counts["/eye/image_raw/compressed"] == counts["/tf"] == counts["/eye/detections"] == len(images) > 3
    )
    assert counts["/odom"] == counts["/imu/data_raw"] > 50 * len(images)
    with pytest.raises(fs.InputError, match=r"must have images, e.g. exact, got"):
        list(write_log(requested, "odometry", None, str(tmp_path / "other.mcap"), False))


def test_the_filter_reads_what_the_sensors_logged(tmp_path, monkeypatch):
    """Wheels, gyroscope, tags and points after ROS 2's messages are those before."""
    from fidsplat.logs import RobotLog
    from fidsplat.vision.detect import Detection

    monkeypatch.setattr("fidsplat.experiments.localise.RATE", 1.0)
    requested, rng = Drive(1, 1), np.random.default_rng(0)
    run = drive(requested.house.mjcf(BODY), np.array([[-0.5, -0.75], [0.5, -0.75]]))
    count = len(requested.image_indices(run))
    codes = [[Detection("apriltag", "36h11", k, None, rng.uniform(0, 640, (4, 2)))] for k in range(count)]
    kind = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2")])
    clouds = [np.zeros(k + 1, kind) for k in range(count)]
    for k, cloud in enumerate(clouds):
        cloud["x"], cloud["z"] = k, rng.normal(size=k + 1)
    monkeypatch.setattr(Drive, "frames", lambda *_: ((None, each) for each in codes))
    monkeypatch.setattr(Drive, "scans", lambda *_: iter(clouds))
    variant = VARIANTS["all sensors"]
    with RobotLog(tmp_path / "run.mcap", up=(0, 0, 1)) as log:
        assert len(list(record(requested, variant, run, None, log))) == count > 1
    read, tags, scans = recorded(tmp_path / "run.mcap", run)
    np.testing.assert_allclose(read.wheels, run.wheels, atol=1e-12)
    np.testing.assert_array_equal(read.gyro, run.gyro)
    for one, other in zip(codes, tags, strict=True):
        assert (other[0].id, other[0].family) == (one[0].id, "36h11")
        np.testing.assert_allclose(other[0].corners, one[0].corners, atol=1e-10)
    for one, other in zip(clouds, scans, strict=True):
        np.testing.assert_array_equal(other, np.stack([one["x"], one["y"], one["z"]], 1))


def test_with_ideal_corners_it_knows_its_way():
    """The filter alone: every tag that the camera could see, with corners where they are."""
    requested = Drive(1, 3)
    house = requested.house
    moved = drive(
        house.mjcf(BODY), np.array([[-0.5, -0.75], [2.0, -0.75]]), errors=Errors(0.03, gyro_bias=0.01, seed=3)
    )
    from fidsplat.vision.detect import Detection
    from fidsplat.vision.visible import visible

    sightings = []
    for k in requested.image_indices(moved):
        camera = camera_at(requested.camera, moved.poses[k])
        tags = [
            p for p in house.markers if p.marker.kind == "apriltag" and visible(p, camera).fraction > 0.99
        ]
        near = [p for p in tags if np.linalg.norm(p.pose[:3, 3] - camera.position) < 1.5]
        sightings.append(
            [Detection("apriltag", "36h11", p.marker.id, None, camera.project(p.corners)) for p in near]
        )
    _, blind = requested.localise(moved, None, requested.camera)
    _, seeing = requested.localise(moved, sightings, requested.camera, 0.05)
    assert seeing["tags"] > 5
    assert seeing["refused"] == 0
    assert seeing["ate_m"] < 0.01 < blind["ate_m"]
    _, near = requested.localise(moved, sightings, requested.camera, 0.05, variant=Variant(reach=1.0))
    assert 0 < near["tags"] < seeing["tags"]
    assert Drive(1, 6)._tags_with_spacing(3.0) == {0, 1, 2, 3}  # of two each at 0.9 and 2.7 m, and the ends
    blind_too = requested.localise(moved, sightings, requested.camera, variant=Variant(without="tags"))[1]
    assert blind_too["ate_m"] == blind["ate_m"]
    aside = np.array([0.6, 0.8])
    off = [[replace(tag, corners=tag.corners + aside) for tag in tags] for tags in sightings]
    bins = requested.corner_errors(moved, off, requested.camera)
    assert [each["tags"] > 0 for each in bins] == [True, True, False, False]
    assert [each["median_px"] for each in bins] == pytest.approx([1.0, 1.0, None, None])
    assert sum(each["tags"] for each in bins) == sum(map(len, sightings))
    back = requested.corner_errors(moved, requested.ideal_corners(moved, off), requested.camera)
    assert [each["median_px"] for each in back] == pytest.approx([0.0, 0.0, None, None])


def test_a_drive_at_another_speed_only_has_a_page(tmp_path):
    times = np.arange(20) / 10
    fs.save_trajectory(fs.Trajectory(times, np.tile(np.eye(4), (20, 1, 1))), tmp_path / "truth-0.25-m-s.tum")
    facts = {"ate_m": 0.01, "worst_m": 0.02, "rpe_m": 0.01, "heading_deg": 0.1, "tags": 3}
    facts |= {"scans": 0, "refused": 0}
    page = write_report(tmp_path, Drive(), "a device", {"0.25 m/s, blur": facts | {"length_m": 60.2}})
    assert "0.25 m/s, blur" in page.read_text()
