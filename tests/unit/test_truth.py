"""Ground truth of images: markers, groups, optical flow; as COCO and BOP, poses as TUM."""

import contextlib
import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.images.files import read_image
from fidsplat.markers import Cylinder
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision.bop import DEPTH_SCALE, BopScene
from fidsplat.vision.coco import CocoAnnotations, run_lengths
from fidsplat.vision.truth import groups_of, optical_flow, points_of, truth_of

SIZE = 160, 120
BOX = 7
LENSES = [None, fs.BrownConrady(k1=-0.2, p1=0.01), fs.Fisheye(k1=0.02), fs.Orthographic()]


def a_camera(pose=None, lens=None):
    f = 60.0 if isinstance(lens, fs.Orthographic) else 110.0
    return fs.Camera.pinhole(*SIZE, f, f, 82, 57, np.eye(4) if pose is None else pose, lens=lens)


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("reference")  # which compiles nothing


@pytest.fixture(scope="module")
def scene():
    """A tilted tag, a box that hides a third of it, a wall."""
    plane = fs.SplatCloud(
        np.zeros((1, 3)), [[1, 0, 0, 0]], [[1.0, 1.0]], [1.0], colors=[[0.2, 0.4, 0.6]]
    ).with_boxes()
    wall = plane.transformed(rigid_matrix((0, 0, 3), scale=4))
    block = plane.transformed(rigid_matrix((-0.3, 0, 1.0), scale=0.2)).with_labels(BOX)
    tag = PlacedMarker(fs.marker("apriltag:36h11:5", size=0.4), rigid_matrix((0, 0, 1.5), (1, 0, 0.15, 0)))
    return fs.Scene((wall, block), a_camera(), (tag,), outputs=("rgb", "depth", "label"))


@pytest.fixture(scope="module")
def frame(scene, renderer):
    return renderer.render(scene)


@pytest.fixture(scope="module")
def truth(scene, frame):
    return truth_of(frame, scene)


def test_a_marker_is_where_it_was_put(truth):
    (tag,) = truth.markers
    assert tag.distance == pytest.approx(1.5)
    assert tag.tilt == pytest.approx(2 * math.atan(0.15))
    np.testing.assert_allclose(tag.truth, tag.placed.pose, atol=1e-12)
    assert tag.corners[1, 0] > tag.corners[0, 0]
    # the block ends at x = -0.1 at 1 m: in the image at 82 - 11
    left, _, right, _ = tag.box
    assert 1 - tag.visible == pytest.approx((71 - left) / (right - left), abs=0.02)


def test_a_marker_that_is_viewed_from_behind_is_tilted_by_more_than_a_right_angle(scene, frame):
    behind = fs.Camera.look_at(*SIZE, 1.0, (0, 0, 4), (0, 0, 1.5))
    (tag,) = truth_of(frame, scene, behind).markers
    assert tag.tilt == pytest.approx(math.pi - 2 * math.atan(0.15))
    assert tag.visible == 0


def test_groups_are_the_pixels_of_their_labels(truth, frame):
    assert set(truth.groups) == {0, 1, BOX}
    block = truth.groups[BOX]
    assert block.mask.sum() == (frame["label"] == BOX).sum()
    # 0.4 m wide at 1 m: 44 px, from 82 - 55 to 82 - 11
    np.testing.assert_allclose(block.box, (27, 35, 71, 79), atol=1)
    rows, columns = np.nonzero(block.mask)
    assert block.box == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)  # edges of its pixels
    empty = groups_of(np.full((4, 5), -1))
    assert empty == {}


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: "pinhole" if lens is None else lens.kind)
def test_flow_follows_a_point_that_moves_before_a_camera_that_moves(lens, scene, renderer):
    before = a_camera(lens=lens)
    after = a_camera(rigid_matrix((0.05, -0.02, 0.1), (1, 0.01, 0.02, -0.03)), lens)
    motion = rigid_matrix((0.1, 0.05, -0.1), (1, 0.1, 0, 0.05))
    images = renderer.render(scene, before, outputs=("depth_first", "label"))
    flow = optical_flow(images["depth_first"], before, after, images["label"], {BOX: motion})
    points = points_of(images["depth_first"], before)
    for label in (0, 1, BOX):
        rows, columns = np.nonzero((images["label"] == label) & np.isfinite(flow[..., 0]))
        picked = slice(None, None, max(1, len(rows) // 50))
        world = points[rows[picked], columns[picked]]
        assert len(world) > 10
        if label == BOX:
            np.testing.assert_allclose(world[:, 2], 1.0, atol=1e-5)
            world = world @ motion[:3, :3].T + motion[:3, 3]
        elif label == 0:
            np.testing.assert_allclose(world[:, 2], 3.0, atol=1e-5)
        there = np.stack([columns[picked] + 0.5, rows[picked] + 0.5], 1) + flow[rows[picked], columns[picked]]
        np.testing.assert_allclose(after.project(world), there, atol=1e-3)


def test_flow_of_what_does_not_move_is_nothing(frame, scene):
    flow = optical_flow(frame["depth"], scene.camera, scene.camera)
    assert np.nanmax(np.abs(flow)) < 1e-5
    assert np.isnan(optical_flow(np.zeros(SIZE[::-1]), scene.camera, scene.camera)).all()


def test_flow_that_cannot_be(frame, scene):
    with pytest.raises(fs.InputError, match="label must be given for the motions of groups"):
        optical_flow(frame["depth"], scene.camera, scene.camera, motions={1: np.eye(4)})
    with pytest.raises(fs.InputError, match="motion of label 1 must be rigid"):
        optical_flow(frame["depth"], scene.camera, scene.camera, frame["label"], {1: np.diag([2, 2, 2, 1])})
    with pytest.raises(fs.InputError, match="the depth must have the camera's shape"):
        points_of(frame["depth"][1:], scene.camera)


def test_truth_of_an_image_of_another_size(scene, frame):
    with pytest.raises(fs.InputError, match="must have the camera's size, 80 x 60 pixels, got 160 x 120"):
        truth_of(frame, scene, fs.Camera.pinhole(80, 60, 50, 50, 40, 30))
    with pytest.raises(fs.InputError, match="the scene must have a camera, got none; give camera="):
        truth_of(dict(frame), fs.Scene())


@pytest.mark.parametrize(("x", "y", "shape"), [(0, 0, (5, 7)), (0, 0, (5, 9)), (2, 3, (9, 10))])
@pytest.mark.parametrize("seed", range(4))
def test_run_lengths_are_those_of_the_mask(seed, x, y, shape):
    mask = np.zeros(shape, bool)
    part = mask[y : y + 5, x : x + 7]
    part[:] = np.random.default_rng(seed).random((5, 7)) < (0, 0.3, 0.7, 1)[seed]
    lengths = run_lengths(part, (x, y), shape)
    assert sum(lengths) == mask.size
    assert 0 not in lengths[1:]
    values = np.repeat(np.arange(len(lengths)) % 2, lengths).astype(bool)
    np.testing.assert_array_equal(values.reshape(mask.shape, order="F"), mask)


@pytest.mark.parametrize("seed", range(4))
def test_boxes_are_those_of_the_pixels(seed):
    """Of labels whose runs continue in the next row, too."""
    label = np.random.default_rng(seed).choice([-1, 0, 7, 7, 7, 7], (4, 5)).astype(np.int32)
    groups = groups_of(label)
    assert groups.keys() == set(np.unique(label)) - {-1}
    for value, group in groups.items():
        y, x = np.nonzero(label == value)
        assert group.box == (x.min(), y.min(), x.max() + 1, y.max() + 1)


def test_coco_reads_what_we_write(tmp_path, truth, scene, frame):
    coco = pytest.importorskip("pycocotools.coco", reason="pip install pycocotools")
    ours = CocoAnnotations({BOX: "block"})
    ours.add("a.png", truth)
    ours.add("b.png", truth_of({"rgb": frame["rgb"]}, scene))
    with pytest.raises(fs.InputError, match=r"got 'a\.png' again"):
        ours.add("a.png", truth)
    ours.save(tmp_path / "truth.json")
    with contextlib.redirect_stdout(io.StringIO()):
        read = coco.COCO(str(tmp_path / "truth.json"))
    assert {c["name"] for c in read.loadCats(read.getCatIds())} == {"apriltag:36h11:5", "block"}
    (tag,) = read.loadAnns(read.getAnnIds(imgIds=[1], catIds=read.getCatIds(["apriltag:36h11:5"])))
    np.testing.assert_array_equal(read.annToMask(tag), frame["label"] == 1)
    np.testing.assert_allclose(np.reshape(tag["keypoints"], (4, 3))[:, :2], truth.markers[0].corners)
    assert tag["num_keypoints"] == 4
    (outline,) = read.loadAnns(read.getAnnIds(imgIds=[2]))
    mask = read.annToMask(outline).astype(bool)
    own = frame["label"] == 1
    assert (mask & own).sum() > 0.98 * own.sum()  # the outline has what the block hides too
    assert outline["area"] == pytest.approx(mask.sum(), rel=0.05)


def test_a_camera_of_bop_is_where_ours_is(tmp_path, scene, renderer):
    """World to camera and marker to camera, in millimetres, say the same of a marker."""
    moved = replace(scene, camera=a_camera(rigid_matrix((0.2, -0.1, 0.4), (1, 0.05, -0.1, 0.15))))
    frame = renderer.render(moved)
    with BopScene(tmp_path / "set/train/000000") as ours:
        ours.add(frame, truth_of(frame, moved))
    camera, gt = (
        json.loads((tmp_path / f"set/train/000000/scene_{name}.json").read_text())["0"]
        for name in ("camera", "gt")
    )
    rotation, move = np.reshape(camera["cam_R_w2c"], (3, 3)), np.array(camera["cam_t_w2c"])
    np.testing.assert_allclose(move, 1000 * moved.camera.world_to_camera[:3, 3], rtol=1e-12)
    tag = moved.markers[0]
    by_marker = 1000 * tag.marker.corners @ np.reshape(gt[0]["cam_R_m2c"], (3, 3)).T + gt[0]["cam_t_m2c"]
    np.testing.assert_allclose(1000 * tag.corners @ rotation.T + move, by_marker, atol=1e-9)


def test_bop_follows_its_format(tmp_path, truth, frame, scene):
    folder = tmp_path / "set/train/000000"
    with BopScene(folder) as ours:
        ours.add(frame, truth)
    gt, info, camera = (
        json.loads((folder / f"scene_{name}.json").read_text())["0"] for name in ("gt", "gt_info", "camera")
    )
    corners = np.array(truth.markers[0].placed.marker.corners)
    rotation, move = np.reshape(gt[0]["cam_R_m2c"], (3, 3)), np.array(gt[0]["cam_t_m2c"])
    seen = (1000 * corners @ rotation.T + move) @ np.reshape(camera["cam_K"], (3, 3)).T
    # BOP counts pixels from the centre of the first
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], truth.markers[0].corners - 0.5, atol=1e-9)
    np.testing.assert_allclose(np.array(camera["cam_t_w2c"]), 0, atol=1e-9)
    assert info[0]["px_count_visib"] == (frame["label"] == 1).sum()
    assert info[0]["visib_fract"] == truth.markers[0].visible
    assert info[0]["px_count_all"] > info[0]["px_count_visib"]
    depth = read_image(folder / "depth/000000.png", deep=True)
    np.testing.assert_allclose(
        depth[..., 0] * DEPTH_SCALE / 1000, frame["depth"], atol=DEPTH_SCALE / 1000 * 0.51
    )
    mask = read_image(folder / "mask_visib/000000_000000.png")
    np.testing.assert_array_equal(mask[..., 0] > 0, frame["label"] == 1)
    models = json.loads((tmp_path / "set/models/models_info.json").read_text())
    assert models["1"]["diameter"] == pytest.approx(400 * math.sqrt(2))
    with pytest.raises(fs.InputError, match="must not have a scene yet"):
        BopScene(folder)
    again = BopScene(tmp_path / "set/train/000001")
    again.add(frame, truth)
    again.save()
    assert json.loads((tmp_path / "set/models/models_info.json").read_text()) == models
    other = replace(scene.markers[0], marker=fs.marker("apriltag:36h11:6", size=0.4))
    for number in (2, 3):  # the label is the other marker's: a new object, the same one in both scenes
        with BopScene(tmp_path / f"set/train/{number:06d}") as another:
            another.add(frame, truth_of(frame, replace(scene, markers=(other,))))
            another.save()  # as the end of the block does
        gt = json.loads((tmp_path / f"set/train/{number:06d}/scene_gt.json").read_text())["0"]
        assert [pose["obj_id"] for pose in gt] == [2]
    after = json.loads((tmp_path / "set/models/models_info.json").read_text())
    assert after == models | {"2": models["1"] | {"spec": "apriltag:36h11:6"}}
    bent = [  # of equal extents
        replace(other, marker=fs.marker("apriltag:36h11:6", size=0.4, shape=Cylinder(0.2, axis=(1, y))))
        for y in (1, -1)
    ]
    with BopScene(tmp_path / "set/train/000004") as last:  # one label for three objects in one scene
        for placed in (*bent, other):
            last.add(frame, truth_of(frame, replace(scene, markers=(placed,))))
    gt = json.loads((tmp_path / "set/train/000004/scene_gt.json").read_text())
    assert [pose["obj_id"] for poses in gt.values() for pose in poses] == [3, 4, 2]
    after = json.loads((tmp_path / "set/models/models_info.json").read_text())
    assert [after[key].get("shape") for key in "234"] == [
        None,
        repr(bent[0].marker.shape),
        repr(bent[1].marker.shape),
    ]


def test_bop_has_no_lenses(tmp_path, truth, frame):
    with pytest.raises(fs.InputError, match="must have a pinhole camera"):
        BopScene(tmp_path / "a/b/c").add(frame, replace(truth, camera=a_camera(lens=LENSES[1])))


def test_poses_as_tum_are_read_by_evo(tmp_path):
    tools = pytest.importorskip("evo.tools.file_interface", reason="pip install evo")
    times = [0.0, 0.5, 1.0]
    poses = [rigid_matrix((0.1 * k, 0, 1), (1, 0.1 * k, 0, 0)) for k in range(3)]
    fs.save_trajectory(fs.Trajectory(times, np.array(poses)), tmp_path / "poses.tum")
    read = tools.read_tum_trajectory_file(tmp_path / "poses.tum")
    np.testing.assert_allclose(read.poses_se3, poses, atol=1e-9)
