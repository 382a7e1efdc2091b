"""Reading markers back from images: visibility, assignment of detections to markers, poses of boards."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import shapely

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import write_png
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision import read_back
from fidsplat.vision.detect import Detection
from fidsplat.vision.readback import corner_error, families_of, match, means
from fidsplat.vision.visible import visible, visible_part
from fidsplat.worlds.yard import demo_scene, demo_views


@pytest.fixture(scope="module")
def scene():
    return demo_scene()


def test_the_visible_share_counts_the_labels_inside_the_outline(scene):
    camera = demo_views()["frontal"]
    placed = scene.markers[0]
    label = np.full((camera.height, camera.width), placed.label)
    assert visible(placed, camera, label).fraction == 1.0
    middle = camera.project(placed.pose[None, :3, 3])[0]
    label[:, round(middle[0]) :] = 0
    assert visible(placed, camera, label).fraction == pytest.approx(0.5, abs=0.01)
    assert visible(placed, camera, np.zeros_like(label)).fraction == 0.0


def test_what_is_outside_the_image_or_facing_away_is_not_visible(scene):
    placed = scene.markers[0]
    camera = demo_views()["frontal"]
    half = fs.Camera.pinhole(
        camera.width, camera.height, camera.fx, camera.fy, 0, camera.cy, camera.world_to_camera
    )
    label = np.full((camera.height, camera.width), placed.label)
    assert visible(placed, half, label).fraction == 0.0
    behind = fs.Camera.look_at(640, 480, 1.0, (0, 0, 3), (0, 0, 0))
    assert visible(placed, behind, np.full((480, 640), placed.label)).fraction == 0.0
    away = fs.Camera.look_at(640, 480, 1.0, (0, 0, -3), (0, 0, -4))
    assert visible(placed, away, np.full((480, 640), placed.label)).fraction == 0.0


def test_detections_are_matched_by_what_they_say_and_then_by_nearness(scene):
    camera = demo_views()["frontal"]
    tag, aruco, qr = scene.markers
    twice = (tag, fs.scenes.PlacedMarker(tag.marker, pose=aruco.pose), qr)

    def seen(placed, kind="apriltag", family="36h11", tag_id: int | None = 5, payload=None):
        return Detection(kind, family, tag_id, payload, camera.project(placed.corners))

    actual = [
        seen(twice[1]),
        seen(twice[0]),
        seen(twice[0], tag_id=6),
        seen(qr, "qr", "v2-L", None, "something else"),
    ]
    codes, others = match(actual, twice, camera)
    assert [code and code[0] for code in codes] == [actual[1], actual[0], None]
    assert others == actual[2:]
    for code, placed in zip(codes[:2], twice, strict=False):
        assert code is not None
        assert np.allclose(code[1], camera.world_to_camera @ placed.pose, atol=1e-5)
    assert families_of(placed.marker for placed in (tag, aruco, qr, tag)) == (
        "apriltag:36h11",
        "aruco:4x4_50",
    )


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer()


def outlined(spec="apriltag:36h11:5", **camera):
    placed = PlacedMarker(fs.marker(spec, size=0.2))
    look = {"position": (0.1, -0.2, -0.6), "target": (0, 0, 0)} | camera
    return placed, fs.Camera.look_at(320, 240, 1.0, look["position"], look["target"])


def test_a_box_is_as_tight_as_the_labels(renderer):
    """The pixels of a rendered tag's label have its box's bounds, to a pixel."""
    placed, camera = outlined()
    frame = renderer.render(fs.Scene(markers=[placed]), camera, outputs=("rgb", "label"))
    (reading,), others = read_back(frame, fs.Scene(markers=[placed]), camera)
    assert others == []
    y, x = np.nonzero(frame["label"] == 1)
    assert np.abs(np.array(reading.box) - (x.min(), y.min(), x.max() + 1, y.max() + 1)).max() <= 1
    assert reading.visible == 1.0
    assert reading.corner_error < 0.1


@pytest.mark.parametrize("spec", ["charuco:5x3:4x4_50", "aprilgrid:3x2:36h11"])
def test_the_outline_of_a_marker_that_is_not_square(spec):
    """Wider than high, head on, by a camera whose focal lengths differ: a module is added on each side."""
    placed = PlacedMarker(fs.marker(spec, size=0.3), rigid_matrix((0.1, -0.05, 2.0)))
    camera = fs.Camera.pinhole(320, 240, 200, 260, 150, 125)
    rows, columns = placed.marker.bits.shape
    assert columns > rows
    corners = placed.marker.corners
    margin = min(1, placed.marker.quiet_zone) * placed.marker.module
    low, high = corners.min(0)[:2] - margin, corners.max(0)[:2] + margin
    (x0, y0), (x1, y1) = ((at + np.array([0.1, -0.05])) * (200, 260) / 2.0 + (150, 125) for at in (low, high))
    assert visible(placed, camera).box == pytest.approx((x0, y0, x1, y1), abs=1e-9)
    assert visible(placed, camera).fraction == pytest.approx(1.0)


def test_what_the_images_edge_cuts_off():
    """Half of a tag that is visible straight on; a tag that reaches behind the camera; one that is visible
    from behind."""
    placed, straight = outlined(position=(0, 0, -1))
    aside = fs.Camera.pinhole(320, 240, straight.fx, straight.fy, 0.0, 120, straight.world_to_camera)
    assert visible(placed, aside).fraction == pytest.approx(0.5, abs=1e-9)
    whole, part = visible_part(placed, aside)
    assert shapely.bounds(part)[:2] == pytest.approx((0, 120 - 0.125 * straight.fx), abs=1e-6)
    assert shapely.area(whole) == pytest.approx((0.25 * straight.fx) ** 2)
    inside, _ = outlined()
    camera = fs.Camera.look_at(320, 240, 1.5, (0.05, 0, -0.01), (1, 0, 0))
    whole, part = visible_part(inside, camera)
    assert 0 < shapely.area(part) < shapely.area(whole)
    # the pixels whose rays meet the printed sheet: the code with a module of quiet zone
    rays = camera.rays(np.stack(np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5), 2).reshape(-1, 2))
    rotation, place = camera.world_to_camera[:3, :3], camera.position
    rays = rays @ rotation
    at = place + np.where(rays[:, 2] > 0, -place[2] / rays[:, 2], np.nan)[:, None] * rays
    hit = (np.abs(at[:, :2]) < 0.125).all(1)
    assert shapely.area(part) == pytest.approx(hit.sum(), rel=0.02)
    behind, camera = outlined(position=(0, 0, 1))
    assert visible(behind, camera).fraction == 0.0


@pytest.mark.parametrize("seed", range(2))
def test_the_visible_share_of_a_bent_marker_counts_pixels_in_its_outline(seed):
    """Parts of a cylinder and of a crumpled sheet, cut off by the image's edge; labels at random."""
    rng = np.random.default_rng(seed)
    shape = ("cylinder,radius=0.06", "crumpled,height=0.01,length=0.1,seed=1")[seed]
    placed = PlacedMarker(fs.marker("apriltag:36h11:5", size=0.2, shape=shape))
    camera = fs.Camera.look_at(160, 120, 1.2, (0.15, 0.1, -0.2), (0.07, 0.02, 0.0))
    label = rng.integers(0, 2, (120, 160)) * placed.label
    outline, part = visible_part(placed, camera)
    y, x = np.mgrid[0.5:120, 0.5:160]
    inside = shapely.contains_xy(part, x, y)
    assert 0 < shapely.area(part) < shapely.area(outline)
    expected = (label[inside] == placed.label).mean() * shapely.area(part) / shapely.area(outline)
    assert visible(placed, camera, label).fraction == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("spec", ["charuco:5x4:4x4_50", "gridboard:3x2:5x5_100", "aprilgrid:3x2:36h11"])
def test_a_board_gives_one_pose(renderer, spec):
    """Also from half of its tags; a tag elsewhere in the image is not assigned to the board."""
    board = PlacedMarker(fs.marker(spec, size=0.3))
    camera = fs.Camera.look_at(640, 480, 0.9, (0.2, -0.15, -0.5), (0, 0, 0))
    scene = fs.Scene(markers=[board], camera=camera, background=(0.5, 0.5, 0.5))
    frame = renderer.render(scene, outputs=("rgb", "label"))
    (reading,), others = read_back(frame, scene)
    assert others == []
    assert reading.detection.name == spec
    assert reading.position_error < 1e-3 * reading.distance
    assert reading.angle_error < np.radians(0.2)
    half = np.array(frame["rgb"])
    half[:, :320] = 0.5
    (reading,), _ = read_back(half, scene)
    assert reading.position_error < 5e-3 * reading.distance
    assert means([reading])["found"] == 1
    (reading,), _ = read_back(np.full_like(half, 0.5), scene)
    assert reading.as_dict()["found"] is False
    assert means([reading])["position_error_mm"] is None


def test_the_truth_is_where_the_frames_own_capture_had_camera_and_markers(renderer):
    """The true poses are those of the frame's own capture, not of the scene: with a camera, a shutter and
    a motion given to `render`, in a batch, and after pickling, which omits functions."""
    placed, own = outlined()
    aside = fs.Camera.look_at(320, 240, 1.0, (0.3, 0.1, -0.7), (0.05, 0, 0))

    def slide(time):
        return rigid_matrix((0.1 * time, 0, 0), (1, 0, 0, 0.1 * time))

    scene = fs.Scene(markers=[placed], camera=own, shutter=fs.Shutter(time=0.5))
    moving = fs.Scene(markers=[replace(placed, motion=slide)], camera=own, shutter=fs.Shutter(time=0.5))
    later, rolling = fs.Shutter(time=1.0), fs.Shutter(time=1.0, exposure_time=1e-4, sub_poses=2, readout=1e-4)
    pose = [0.15, 0.1, -0.7, 1.0, 0, 0, 0]
    frames = [
        (scene, renderer.render(scene, aside), 0.0),
        (moving, renderer.render(moving, aside), 0.5),
        (moving, renderer.render(moving, aside, shutter=later), 1.0),
        (moving, pickle.loads(pickle.dumps(renderer.render(moving, shutter=rolling))), 1.0),
        (moving, renderer.render(moving, fs.Capture(aside)), 0.0),  # which does not move
        (scene, renderer.render(scene, motion=fs.Motion(lambda t: aside.world_to_camera, {1: slide})), 0.5),
        (moving, renderer.render(scene, motion=fs.Motion(None, {1: slide}), shutter=later), 1.0),
    ]
    batch = renderer.render_batch(
        scene, own, poses=[pose, pose], groups={1: [[0, 0, 0, 1, 0, 0, 0], [0.1, 0, 0, 1, 0, 0, 0]]}
    )
    for copies in (batch, pickle.loads(pickle.dumps(batch))):
        frames += [(scene, copies.frame(i), None) for i in range(2)]
    for case, (made_of, frame, time) in enumerate(frames):
        (reading,), others = read_back(frame, made_of)
        assert others == []
        assert reading.position_error < 2e-3, case
        assert reading.angle_error < np.radians(1), case
        if time is not None:
            np.testing.assert_allclose(reading.placed.pose, slide(time), atol=1e-12)
    (reading,), _ = read_back(frames[1][1], moving, own)  # a camera that is given takes the place of both
    assert reading.position_error > 0.1


def test_a_pickled_frame_is_regenerated_by_its_capture(renderer):
    """Of a rolling shutter too, all of whose poses come along; of other times it says that it has none."""
    placed, camera = outlined()
    scene = fs.Scene(markers=[placed], camera=camera)
    moved = fs.Motion(lambda time: rigid_matrix((-time, 0, 1)))
    frame = renderer.render(scene, motion=moved, shutter=fs.Shutter(0.1, exposure_time=0.1, readout=0.2))
    again = pickle.loads(pickle.dumps(frame))
    assert np.array_equal(renderer.render(scene, again.capture)["rgb"], frame["rgb"])
    with pytest.raises(fs.InputError, match="time must be a sampled time of this motion"):
        again.capture.motion.camera_at(7.0)


def test_the_error_of_corners_is_the_root_mean_square_of_their_distances():
    corners = np.array([[0, 0], [9, 0], [9, 9], [0, 9]], float)
    code = Detection("apriltag", "36h11", 5, None, corners + np.array([3, 4]))
    assert corner_error(code, corners) == pytest.approx(5)


def test_markers_that_face_away_or_lie_outside_are_not_missed(tmp_path, monkeypatch, capsys):
    """One in front of the camera, one turned over, one next to the image; a blank image misses the first."""
    tag = fs.marker("aruco:4x4_50:7", size=0.2)
    places = [
        rigid_matrix((0.05, 0, 0.1)),
        rigid_matrix((-0.1, 0.05, 0), (0, 1, 0, 0.1)),
        rigid_matrix((3, 0, 0), (1, 0.1, 0, 0)),
    ]
    scene = fs.Scene(markers=[PlacedMarker(tag, pose) for pose in places], camera=outlined()[1])
    blank = np.full((240, 320, 3), 128, np.uint8)
    actual = means(read_back(blank, scene).readings)
    assert (actual["markers"], actual["found"], actual["not_visible"]) == (1, 0, 2)
    monkeypatch.chdir(tmp_path)
    scene.save("scene.toml")
    write_png("blank.png", blank)
    assert main(["detect", "blank.png", "--scene", "scene.toml"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "4x4_50" in line or "mean" in line]
    for row, words in zip(rows, ("no ", "faces away", "not in view", "0 of 1"), strict=True):
        assert words in row


def test_images_that_cannot_be_read_back():
    scene, image = fs.Scene(markers=[outlined()[0]]), np.zeros((240, 320, 3), np.uint8)
    with pytest.raises(fs.InputError, match="the scene must have a camera, got none; give camera="):
        read_back(image, scene)
    wide = fs.Camera.look_at(321, 240, 1.0, (0, 0, -1), (0, 0, 0))
    with pytest.raises(fs.InputError, match=r"must have the camera's size, 321 x \d+ pixels, got 320 x 240"):
        read_back(image, scene, wide)
