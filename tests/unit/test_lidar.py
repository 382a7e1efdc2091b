"""LiDAR scans against float64, closed forms, trimesh's ray casting, and readers of other projects."""

import json
import math
import runpy
import struct
import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cameras import RayTable
from fidsplat.capture.lidar import Lidar, Rosette, Spinning, presets
from fidsplat.splats.rotations import matrix_to_quaternion

UNEVEN = tuple(np.radians([-24.0, -11.0, -7.0, -5.5, -1.0, 0.0, 2.5, 9.0, 30.0]))
IDEAL = Lidar(Spinning(UNEVEN, 48), near=0.1)


def turned(yaw: float, pitch: float, roll: float, position) -> np.ndarray:
    """A pose from angles in radians."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (yaw, pitch, roll))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    pose = np.eye(4)
    pose[:3, :3] = about_z @ about_y @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pose[:3, 3] = position
    return pose


MOUNT = turned(2.4, -0.3, 0.2, (0.7, -0.4, 0.3))


def plane(normal, offset: float, side: float, count=16, color=0.6, label=0, left=-99.0, opacity=0.97):
    """A square of overlapping disks in the plane normal . x = offset, those with y > left."""
    w = np.asarray(normal, float) / np.linalg.norm(normal)
    u = np.cross(w, np.eye(3)[np.argmin(np.abs(w))])
    u /= np.linalg.norm(u)
    rotation = np.stack([u, np.cross(w, u), w], 1)
    a, b = (each.ravel() for each in np.meshgrid(*[(np.arange(count) + 0.5) / count - 0.5] * 2))
    means = side * (a[:, None] * rotation[:, 0] + b[:, None] * rotation[:, 1]) + offset * w
    means = means[means[:, 1] > left]
    n = len(means)
    quats = np.tile(matrix_to_quaternion(rotation), (n, 1))
    scales = np.full((n, 2), 1.2 * side / count)
    return fs.SplatCloud(
        means, quats, scales, np.full(n, opacity), colors=np.full((n, 3), color), labels=np.full(n, label)
    )


def joined(*clouds: fs.SplatCloud) -> fs.SplatCloud:
    return fs.SplatCloud.concatenate(clouds)


@pytest.fixture(scope="module")
def room() -> fs.SplatCloud:
    """Two oblique walls and random splats between them."""
    rng = np.random.default_rng(1)
    n = 120
    quats = rng.normal(size=(n, 4))
    clutter = fs.SplatCloud(
        rng.uniform(-3, 3, (n, 3)), quats, rng.uniform(0.1, 0.6, (n, 2)), rng.uniform(0.2, 0.9, n),
        colors=rng.uniform(0, 1, (n, 3)), labels=np.full(n, 5),
    )  # fmt: skip
    return joined(plane((1, 0.3, 0.1), 4.0, 9.0), plane((-0.2, -1, 0.2), 3.5, 9.0, label=2), clutter)


@pytest.fixture(scope="module", params=("opencl", "warp:cpu"))
def renderer(request) -> fs.Renderer:
    return fs.Renderer(request.param)


PATTERNS = (IDEAL.pattern, Rosette(math.radians(35), (700.0, -430.0), 400))


@pytest.mark.parametrize("pattern", PATTERNS, ids=("spinning", "rosette"))
def test_ranges_are_those_of_the_reference(renderer, room, pattern):
    lidar = replace(IDEAL, pattern=pattern)
    actual = fs.scan(room, lidar, MOUNT, renderer=renderer, label=True)
    expected = fs.scan(room, lidar, MOUNT, renderer=fs.Renderer("reference"), label=True)
    same = (actual.range > 0) == (expected.range > 0)
    assert same.mean() > 0.99
    assert (expected.range > 0).mean() > 0.3
    both = (actual.range > 0) & (expected.range > 0)
    error = np.abs(actual.range[both] / expected.range[both] - 1)
    # a ray that passes a surface at an opacity of 0.5 ends at the next one
    assert np.quantile(error, 0.99) < 1e-5
    assert np.abs(actual.intensity - expected.intensity)[both][error < 1e-5].max() < 1e-4
    assert (actual.label == expected.label)[both][error < 1e-5].mean() > 0.99


@pytest.fixture(scope="module")
def device() -> fs.Renderer:
    return fs.Renderer()


@pytest.mark.parametrize("pattern", PATTERNS, ids=("spinning", "rosette"))
def test_a_wall_is_where_its_equation_says(device, pattern):
    normal = np.array([0.9, -0.2, 0.3]) / np.linalg.norm([0.9, -0.2, 0.3])
    pose = turned(0.2, 0.1, -0.3, (-0.5, 0.4, 0.1))
    actual = fs.scan(plane(normal, 3.0, 12.0, 30), replace(IDEAL, pattern=pattern), pose, renderer=device)
    rays = actual.directions @ pose[:3, :3].T
    ranges = (3.0 - normal @ pose[:3, 3]) / (rays @ normal)
    hit = actual.range[0] > 0
    assert hit.sum() > 80
    np.testing.assert_allclose(actual.range[0][hit], ranges[hit], rtol=1e-5)
    points = actual.world_points[0][hit]
    np.testing.assert_allclose(points @ normal, 3.0, atol=1e-4)
    # Lambert: sRGB 0.6 reflects 31.9 %
    expected = ((0.6 + 0.055) / 1.055) ** 2.4 * np.abs(rays @ normal)[hit]
    middle = np.linalg.norm(points - 3.0 * normal, axis=1) < 3
    np.testing.assert_allclose(actual.intensity[0][hit][middle], expected[middle], rtol=2e-2)


def test_the_intensity_is_that_of_the_surface_however_opaque(device):
    """A wall of faint disks in front of a black one; the rays end at the first."""
    faint, black = plane((1, 0, 0), 5.0, 18.0, 32, opacity=0.12), plane((1, 0, 0), 9.0, 18.0, color=0.0)
    full, actual = (
        fs.scan(joined(*walls), IDEAL, np.eye(4), renderer=device).intensity[0]
        for walls in ((plane((1, 0, 0), 5.0, 18.0, 32),), (faint, black))
    )
    ahead = (full > 0) & (np.abs(np.arctan2(*IDEAL.directions().T[1::-1])) < 0.3)
    assert ahead.sum() > 20
    np.testing.assert_allclose(actual[ahead], full[ahead], rtol=0.01)


def test_a_moving_lidar_sees_a_wall_from_its_pose_at_the_time_of_the_beam(device):
    """A wall at x = 5 scanned while driving at 4 m/s and turning at 1 rad/s."""
    lidar = replace(IDEAL, bands=48)

    def world_from_lidar(time: float) -> np.ndarray:
        return turned(1.0 * (time - 0.05), 0.1, 0.0, (4 * time, 1 * time, 0.2))

    motion = fs.Motion(camera=lambda time: np.linalg.inv(world_from_lidar(time)))
    actual = fs.scan(plane((1, 0, 0), 5.0, 30.0, 40), lidar, motion=motion, renderer=device)
    hit = actual.range[0] > 0
    assert hit.sum() > 100
    for beam in np.flatnonzero(hit)[::7]:
        pose = world_from_lidar(actual.time[beam])
        expected = (5.0 - pose[0, 3]) / (pose[:3, :3] @ actual.directions[beam])[0]
        assert actual.range[0, beam] == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(actual.world_points[0][hit][:, 0], 5.0, atol=1e-4)
    still = fs.scan(plane((1, 0, 0), 5.0, 30.0, 40), lidar, world_from_lidar(0.05), renderer=device)
    assert np.abs(still.range - actual.range)[0][hit & (still.range[0] > 0)].max() > 0.1


def test_a_moving_rosette_has_fewer_poses_than_beams(device):
    pattern = Rosette(math.radians(20), (700.0, -430.0), 300)
    lidar = replace(IDEAL, pattern=pattern, bands=10)
    motion = fs.Motion(camera=lambda t: np.linalg.inv(turned(0, 0, 0, (3 * t, 0, 0))))
    actual = fs.scan(plane((1, 0, 0), 5.0, 12.0, 30), lidar, motion=motion, start=0.2, renderer=device)
    hit = actual.range[0] > 0
    assert hit.mean() > 0.9
    assert len(actual.poses) == 10
    np.testing.assert_allclose(actual.world_points[0][hit][:, 0], 5.0, atol=1e-4)
    late = np.abs(actual.poses[actual.pose_index][:, 0, 3] - 3 * (0.2 + actual.time))
    assert late.max() <= 3 * 0.1 / (2 * 10) + 1e-9


def test_a_scan_without_a_pose_is_at_the_moving_camera_at_its_start(device):
    camera = fs.Camera.pinhole(8, 8, 8, 8, 4, 4)
    motion = fs.Trajectory([0.0, 1.0], [np.eye(4), turned(0, 0, 0, (0, 0, -1.0))])  # camera_from_world
    scene = fs.Scene([plane((0, 0, 1), 4.0, 6.0)], camera=camera, camera_motion=motion)
    for time, distance in ((0.0, 4.0), (1.0, 3.0)):
        actual = fs.scan(scene, IDEAL, renderer=device, start=time)
        assert np.nanmedian(actual.points[..., 0]) == pytest.approx(distance, rel=1e-5)


def test_a_batch_equals_single_scans(renderer, room):
    poses = np.array([[0.1, 0.2, 0.3, 0.8, 0, 0, 0.6], [-0.5, 0.3, 0.0, 0, 0.6, 0.8, 0]])
    lidar = replace(IDEAL, noise=0.02, dropouts=0.1)
    batch = fs.scan_batch(room, lidar, poses, renderer=renderer, label=True)
    single = fs.scan(room, lidar, (poses[0, :3], poses[0, 3:]), renderer=renderer, label=True)
    np.testing.assert_array_equal(batch[0].range, single.range)
    assert (batch[0].range != batch[1].range).any()


def test_moving_splats_of_a_batch_are_at_the_middle_of_the_scan(device):
    motion = fs.Trajectory([0.0, 1.0], [np.eye(4), turned(0, 0, 0, (1.0, 0, 0))])
    scene = fs.Scene([plane((1, 0, 0), 4.0, 6.0)], cloud_motions={0: motion})
    (batch,) = fs.scan_batch(scene, IDEAL, [[0, 0, 0, 1, 0, 0, 0]], renderer=device, start=0.45)
    single = fs.scan(scene, IDEAL, np.eye(4), renderer=device, start=0.45)  # from 0.45 s to 0.55 s
    assert np.nanmedian(single.points[..., 0]) == pytest.approx(4.5, abs=0.05)
    assert np.nanmedian(batch.points[..., 0]) == pytest.approx(4.5, rel=1e-5)
    assert len(batch.poses) == 1


def test_reflectivities_do_not_add_labels(device):
    scene, lidar = plane((1, 0, 0), 4.0, 6.0, label=7), replace(IDEAL, reflectivity={7: 0.25})
    with_label, without = (
        fs.scan(scene, lidar, np.eye(4), renderer=device, label=label) for label in (True, False)
    )
    assert without.label is None
    assert "label" not in without.cloud().dtype.names
    assert set(np.unique(with_label.label)) == {-1, 7}
    np.testing.assert_array_equal(without.intensity, with_label.intensity)
    assert without.intensity.max() == pytest.approx(0.25, rel=0.01)


def test_against_ray_casting_of_the_mesh(device):
    """Splats on the faces of a box with thickness, against trimesh's intersections."""
    trimesh = pytest.importorskip("trimesh", reason="trimesh casts the rays")
    half = (3.0, 2.5, 1.2)
    mesh = trimesh.creation.box(extents=2 * np.array(half))
    faces = [plane(sign * np.eye(3)[axis], half[axis], 7.0, 32) for axis in range(3) for sign in (1, -1)]
    pose = turned(0.7, 0.05, -0.1, (0.4, -0.3, 0.1))
    actual = fs.scan(joined(*faces), IDEAL, pose, renderer=device)
    rays = actual.directions @ pose[:3, :3].T
    expected = np.full(len(rays), np.inf)
    for triangle, normal in zip(mesh.triangles, mesh.face_normals, strict=True):
        places, valid = trimesh.intersections.planes_lines(
            plane_origins=np.tile(triangle[0], (len(rays), 1)),
            plane_normals=np.tile(normal, (len(rays), 1)),
            line_origins=np.tile(pose[:3, 3], (len(rays), 1)),
            line_directions=rays,
        )
        weights = trimesh.triangles.points_to_barycentric(np.tile(triangle, (len(places), 1, 1)), places)
        away = ((places - pose[:3, 3]) * rays[valid]).sum(1)
        inside = (weights >= -1e-12).all(1) & (away > 0)
        beams = np.flatnonzero(valid)[inside]
        expected[beams] = np.minimum(expected[beams], away[inside])
    assert (actual.range[0] > 0).all()
    error = np.abs(actual.range[0] - expected)
    # splats of one face reach over its edge by their radius, so that beams near an edge end early
    assert np.median(error) < 1e-5
    assert (error < 1e-4).mean() > 0.9


def test_dual_returns_at_an_edge(device):
    """A beam that is half on a near bright plane and half on a far one has two returns."""
    scene = joined(plane((1, 0, 0), 2.0, 4.0, 32, left=0.04), plane((1, 0, 0), 6.0, 20.0, 40, color=0.9))
    pattern = Spinning((0.0,), 720)
    lidar = Lidar(pattern, divergence=0.3, rays=64, returns=("first", "last"), near=0.1)
    actual = fs.scan(scene, lidar, np.eye(4), renderer=device)
    ahead = np.arange(340, 380)
    both = (actual.range > 0).all(0)[ahead]
    assert 0 < both.sum() < len(ahead)
    assert np.allclose(actual.range[0, ahead][both], 2.0, atol=0.05)
    assert np.allclose(actual.range[1, ahead][both], 6.0, atol=0.2)
    strongest = fs.scan(scene, replace(lidar, returns="strongest"), np.eye(4), renderer=device)
    assert set(np.round(strongest.range[0, ahead])) <= {2.0, 6.0}
    # a plane that fills the beam is one return
    whole = fs.scan(plane((1, 0, 0), 6.0, 20.0, 40), lidar, np.eye(4), renderer=device)
    assert whole.range[0, 360] > 0
    assert whole.range[1, 360] == 0


def test_noise_and_drop_outs_follow_their_settings(device):
    lidar = Lidar(Spinning(tuple(np.linspace(-0.3, 0.3, 24)), 360), near=0.1, noise=0.01, noise_growth=0.002)
    scene = plane((1, 0, 0), 5.0, 12.0, 24)
    ideal = fs.scan(scene, replace(lidar, noise=0.0, noise_growth=0.0), np.eye(4), renderer=device).range
    noisy = fs.scan(scene, lidar, np.eye(4), renderer=device).range
    hit = ideal > 0
    scaled = (noisy - ideal)[hit] / (0.01 + 0.002 * ideal[hit])
    assert np.std(scaled) == pytest.approx(1.0, abs=0.06)
    assert abs(scaled.mean()) < 0.07
    np.testing.assert_array_equal(noisy, fs.scan(scene, lidar, np.eye(4), renderer=device).range)
    assert (noisy != fs.scan(scene, replace(lidar, seed=1), np.eye(4), renderer=device).range).any()
    bounded = fs.scan(scene, replace(lidar, noise=0.5, near=4.9, far=5.3), np.eye(4), renderer=device).range
    assert 4.9 <= bounded[bounded > 0].min() < bounded.max() <= 5.3
    lost = fs.scan(scene, replace(lidar, dropouts=0.25), np.eye(4), renderer=device).range
    assert (lost[hit] == 0).mean() == pytest.approx(0.25, abs=0.04)


def test_detection_falls_with_range_and_incidence(device):
    """At the detection range a facing surface of 10 % is detected in 90 % of the beams."""
    pattern = Spinning(tuple(np.linspace(-0.02, 0.02, 40)), 1000)
    dark = plane((1, 0, 0), 10.0, 3.0, 24, label=7)
    lidar = Lidar(pattern, near=0.1, reflectivity={7: 0.1})
    ahead = np.abs(np.arctan2(*fs.scan(dark, lidar, np.eye(4), renderer=device).directions.T[1::-1])) < 0.05

    def share(**changes) -> float:
        return float(
            (fs.scan(dark, replace(lidar, **changes), np.eye(4), renderer=device).range[0][ahead] > 0).mean()
        )

    assert share() == 1.0
    assert share(detection_range=10.0) == pytest.approx(0.9, abs=0.04)
    assert share(detection_range=20.0) > 0.99 > 0.5 > share(detection_range=5.0)
    assert share(detection_range=10.0, reflectivity={7: 0.02}) < 0.1
    assert share(far=9.0) == 0.0
    assert share(near=10.5) == 0.0


def test_presets_have_the_values_of_their_sources():
    values = json.loads(files("fidsplat.capture").joinpath("lidars.json").read_text("utf-8"))
    assert set(values) == set(presets())
    assert Lidar.preset("os1-64").camera() is Lidar.preset("os1-64").camera()  # rays are computed once
    assert all(value["source"] for value in values.values())
    vlp, os1, livox = (Lidar.preset(name) for name in ("vlp-16", "OS1-64", "livox-mid-40"))
    np.testing.assert_allclose(np.degrees(vlp.pattern.elevations), np.arange(-15, 16, 2), atol=1e-9)
    assert (os1.pattern.rings, os1.pattern.columns, os1.duration) == (64, 1024, 0.1)
    angles = np.degrees(np.arccos(livox.directions()[:, 0]))
    assert 19 < angles.max() <= 19.2001
    # a rosette differs from scan to scan
    assert np.abs(livox.directions(0.0) - livox.directions(0.1)).max() > 0.1


def test_directions_of_a_spinning_lidar_turn_clockwise_from_behind():
    rays = IDEAL.directions().reshape(48, 9, 3)
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    assert (np.diff(azimuth[:, 0]) < 0).all()
    assert azimuth[0, 0] > 3
    assert azimuth[-1, 0] < -3
    np.testing.assert_allclose(np.arcsin(rays[..., 2]), np.tile(UNEVEN, (48, 1)), atol=1e-6)


@pytest.mark.parametrize("ending", ["pcd", "ply", "npy"])
def test_files_of_points(device, tmp_path, ending):
    actual = fs.scan(plane((1, 0, 0), 3.0, 6.0, label=4), IDEAL, np.eye(4), label=True, renderer=device)
    cloud = actual.cloud()
    xyz = np.stack([cloud[axis] for axis in "xyz"], 1)
    elevations = np.arcsin(xyz[:, 2] / np.linalg.norm(xyz, axis=1))
    np.testing.assert_allclose(elevations, np.array(UNEVEN)[cloud["ring"]], atol=1e-5)
    file = tmp_path / f"scan.{ending}"
    actual.save(file)
    if ending == "npy":
        read = np.load(file)
    elif ending == "pcd":
        head, data = file.read_bytes().split(b"DATA binary\n", 1)
        lines = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
        names, sizes, kinds = (lines[key].split() for key in ("FIELDS", "SIZE", "TYPE"))
        codes = [kind.lower() + size for kind, size in zip(kinds, sizes, strict=True)]
        read = np.frombuffer(data, list(zip(names, codes, strict=True)))
        assert int(lines["POINTS"]) == len(read)
    else:
        trimesh = pytest.importorskip("trimesh", reason="trimesh reads the file")
        vertices = np.asarray(trimesh.load(file, process=False).vertices)
        np.testing.assert_allclose(vertices, xyz, atol=1e-6)
        return
    assert read.dtype.names == cloud.dtype.names
    assert len(cloud) == (actual.range > 0).sum() > 10
    np.testing.assert_array_equal(read, cloud)
    assert (set(read["label"]), read["ring"].max()) == ({4}, 8)


def test_messages_have_the_points(device, tmp_path):
    """A PointCloud2 in a log, read by rosbags and struct alone."""
    pytest.importorskip("mcap", reason="fidsplat[logs]")
    from mcap.reader import make_reader

    from fidsplat.logs import RobotLog

    actual = fs.scan(plane((1, 0, 0), 3.0, 6.0), IDEAL, np.eye(4), renderer=device)
    cloud, path = actual.cloud(), tmp_path / "run.mcap"
    with RobotLog(path) as log:
        log.points(12.25, "lidar", cloud)
    with path.open("rb") as stream:
        ((schema, channel, message),) = make_reader(stream).iter_messages()
    assert (schema.name, channel.topic) == ("sensor_msgs/msg/PointCloud2", "/lidar/points")
    from rosbags.typesys import Stores, get_typestore

    read = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(message.data, schema.name)
    assert (read.header.frame_id, read.header.stamp.sec, read.header.stamp.nanosec) == (
        "lidar",
        12,
        250000000,
    )
    assert (read.height, read.width, read.is_dense) == (1, len(cloud), True)
    fields = {one.name: (one.offset, one.datatype) for one in read.fields}
    assert [fields[name][1] for name in ("x", "intensity", "ring", "time")] == [7, 7, 4, 7]
    data = bytes(read.data)
    for k in (0, len(cloud) - 1):
        at = k * read.point_step
        assert struct.unpack_from("<f", data, at + fields["y"][0])[0] == cloud["y"][k]
        assert struct.unpack_from("<H", data, at + fields["ring"][0])[0] == cloud["ring"][k]
        assert struct.unpack_from("<f", data, at + fields["time"][0])[0] == cloud["time"][k]


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Lidar.preset("os1-46"), "did you mean 'os1-64'"),
        (lambda: Lidar.preset("os1-64", nose=1), "did you mean 'noise'"),
        (lambda: Spinning((1.6,)), "elevations must be"),
        (lambda: Spinning((0.1, 0.2), azimuths=(0.1,)), "azimuths must have one number"),
        (lambda: Spinning((-15, 15)), "elevations must be .* got .-15, 15.; np.radians converts degrees"),
        (lambda: Rosette(2.0, (1.0, 2.0)), "half_angle must be"),
        (lambda: Rosette(0.3, 1.0), "rates must be two numbers in rad/s, one for each prism, got 1.0"),
        (lambda: Rosette(0.3, (1.0, math.nan)), "rates must be two numbers"),
        (lambda: replace(IDEAL, far=math.inf), "lidar far must be metres, from near to 1e9, got inf"),
        (lambda: replace(IDEAL, returns=("first", "last")), "rays must be at least 2 .* got 1; give"),
        (lambda: replace(IDEAL, returns=("middle",)), "unknown return"),
        (lambda: replace(IDEAL, far=0.01), "lidar far must be metres, from near"),
        (lambda: replace(IDEAL, detection_range="far"), "detection_range must be metres, above 0, got 'far'"),
        (lambda: replace(IDEAL, reflectivity=[0.1]), "reflectivity must be a dict"),
        (lambda: replace(IDEAL, reflectivity={"leaf": 0.1}), "label of lidar reflectivity must be a whole"),
        (lambda: RayTable(np.zeros((2, 2, 3))), "must have a ray"),
        (lambda: RayTable(np.tile([0, 0, -1.0], (2, 2, 1))), "1 degree from -z"),
        (lambda: fs.scan(plane((1, 0, 0), 1, 1, 2), IDEAL), "pose must be given"),
        (lambda: fs.scan(plane((1, 0, 0), 1, 1, 2), IDEAL, renderer="opencl"), "renderer must be a Renderer"),
        (lambda: fs.scan(plane((1, 0, 0), 1, 1, 2), IDEAL, 2 * np.eye(4)), "pose of a lidar"),
    ],
)
def test_refusals(make, text):
    with pytest.raises(fs.InputError, match=text):
        make()


def test_the_example_maps_benches_and_floor(tmp_path, monkeypatch):
    """Against the walls of the greenhouse, from a sensor that moves during the scan."""
    example = Path(__file__).resolve().parents[2] / "examples" / "lidar.py"
    monkeypatch.setattr(sys, "argv", [str(example), "--scans", "1", "-o", str(tmp_path / "map.npy")])
    runpy.run_path(str(example), run_name="__main__")
    x, y, z = (np.load(tmp_path / "map.npy")[axis] for axis in "xyz")
    bench = y[(np.abs(y - 0.2) < 0.15) & (z > 0.1) & (z < 0.45) & (x > 0.1) & (x < 2.3)]
    floor = z[z < 0.1]
    assert min(len(bench), len(floor)) > 100
    assert abs(np.median(bench) - 0.2) < 0.01
    assert abs(np.median(floor)) < 0.01
