"""Photographs to a metric data set: adjustment of tags, world frame, EXIF, frames of a video."""

import importlib
import math
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat import InputError
from fidsplat.cameras import BrownConrady
from fidsplat.images.exif import ORIENTATION, read_exif, with_exif
from fidsplat.images.files import read_image
from fidsplat.photographs.adjustment import Adjustment, TagView, adjust
from fidsplat.photographs.dataset import Written
from fidsplat.photographs.frame import camera_up, leaning, world_frame
from fidsplat.photographs.mapping import Model
from fidsplat.photographs.photos import camera_groups, copy_photos
from fidsplat.photographs.picks import parse_scale, scale_of
from fidsplat.photographs.rolling_shutter import MIN_DISPLACEMENT, MIN_FRACTION, readout_motion
from fidsplat.photographs.settings import CaptureSettings
from fidsplat.photographs.steps import Captured, photographs_to_scene
from fidsplat.photographs.tags import box_of, module_colors, parse_tags, same_tag
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import quaternion_to_matrix, rigid_matrix
from fidsplat.train.boxes import marker_mask
from fidsplat.vision.video_frames import choose_frames, measure_frames

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2


def photographed(seed, scale, noise=0.1, count=8, tags=3, shaken=0.0):
    """Cameras in a model of `scale` metres per unit, corners of tags in them, sizes and poses in metres."""
    rng, true, cameras = np.random.default_rng(seed), [], []
    for _ in range(count):
        position = rng.uniform((-1, -0.6, -1.8), (1, 0.6, -1.2))
        pose = fs.Camera.look_at(641, 481, 1.0, position, rng.normal(0, 0.1, 3)).world_to_camera
        true.append(fs.Camera.pinhole(641, 481, 600, 660, 310, 250, pose))
        pose = true[-1].world_to_camera.copy()
        pose[:3, 3] /= scale
        pose[:3, :3] = quaternion_to_matrix(np.array([1, *rng.normal(0, shaken / 2, 3)])) @ pose[:3, :3]
        cameras.append(true[-1].with_pose(pose))
    sizes = {f"tag {k}": 0.1 + 0.05 * k for k in range(tags)}
    poses = {tag: rigid_matrix(rng.uniform(-0.4, 0.4, 3), [1, *rng.uniform(-0.3, 0.3, 3)]) for tag in sizes}
    views = [
        TagView(tag, i, camera.project(SQUARE * size @ poses[tag][:3, :3].T + poses[tag][:3, 3]))
        for i, camera in enumerate(true)
        for tag, size in sizes.items()
    ]
    noisy = [TagView(v.tag, v.image, v.corners + rng.normal(0, noise, (4, 2))) for v in views]
    return cameras, noisy, sizes, poses


def test_exact_corners_give_scale_and_poses():
    cameras, views, sizes, poses = photographed(0, scale=0.37, noise=0.0)
    adjusted = adjust(cameras, views, sizes)
    assert adjusted.scale == pytest.approx(0.37, rel=1e-9)
    assert adjusted.rms < 1e-6
    for tag, pose in poses.items():
        np.testing.assert_allclose(adjusted.poses[tag][:3, :3], pose[:3, :3], atol=1e-8)
        np.testing.assert_allclose(adjusted.poses[tag][:3, 3], pose[:3, 3] / 0.37, atol=1e-8)


@pytest.mark.parametrize("shaken", [0.0, 3e-4])
def test_the_standard_error_is_that_of_repeated_captures(shaken):
    """Also with errors of the cameras' directions, which all corners of a photograph share."""
    normalised = []
    for seed in range(12):
        adjusted = adjust(*photographed(seed, scale=2.5, tags=2, shaken=shaken)[:3])
        normalised.append(math.log(adjusted.scale / 2.5) / adjusted.scale_error)
    assert 0.3 < np.mean(np.square(normalised)) < 2.2  # chi squared with 12 degrees of freedom: 98 %


def test_a_tag_of_one_photograph_is_placed_by_the_scale_of_the_others():
    cameras, views, sizes, poses = photographed(1, scale=2.0, noise=0.02)
    views = [view for view in views if view.tag != "tag 2" or view.image == 3]
    adjusted = adjust(cameras, views, sizes)
    assert "tag 2" not in adjusted.scales
    assert np.linalg.norm(2.0 * adjusted.poses["tag 2"][:3, 3] - poses["tag 2"][:3, 3]) < 0.005


def test_a_wrong_detection_is_rejected():
    cameras, views, sizes, _ = photographed(2, scale=2.0)
    views[4] = TagView(views[4].tag, views[4].image, views[4].corners + 60)
    adjusted = adjust(cameras, views, sizes)
    assert adjusted.rejected == (views[4],)
    assert adjusted.scale == pytest.approx(2.0, rel=0.005)


def test_tags_that_contradict_are_errors():
    cameras, views, sizes, _ = photographed(3, scale=2.0, tags=2)
    slightly = adjust(cameras, views, sizes | {"tag 1": sizes["tag 1"] * 1.03})
    assert slightly.disagreements == [("tag 0", "tag 1", pytest.approx(math.log(1.03), abs=0.005))]
    assert not adjust(cameras, views, sizes).disagreements
    with pytest.raises(InputError, match=r"sizes of tags must agree.*would be 0\.1(5|499|501) m"):
        adjust(cameras, views, sizes | {"tag 1": 0.25})
    moved = [view if view.image % 2 else TagView(view.tag, view.image, view.corners + 50) for view in views]
    with pytest.raises(InputError, match="at one place"):
        adjust(cameras, moved, sizes)
    with pytest.raises(InputError, match="from at least 2 positions, got tag 0 in 1, tag 1 in 1"):
        adjust(cameras, views[:2], sizes)


def level(azimuth, roll=0.0, pitch=0.0):
    """A camera of a world with z up, around the origin."""
    position = np.array([math.sin(azimuth), -math.cos(azimuth), math.tan(pitch)])
    side = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    return fs.Camera.look_at(64, 48, 1.0, position, (0, 0, 0), np.array([0, 0, 1.0]) + roll * side)


def test_cameras_held_level_give_the_vertical():
    cameras = [level(azimuth, pitch=0.6) for azimuth in np.linspace(0, 3, 9)]
    np.testing.assert_allclose(camera_up(cameras), (0, 0, 1), atol=0.002)
    alike = [level(0.3, roll, pitch=-0.2) for roll in (-0.1, 0.1)]  # one azimuth does not determine the pitch
    assert camera_up(alike)[2] > 0.95


def test_a_leaning_vertical_is_noticed_where_the_cameras_have_one():
    cameras = [level(azimuth, pitch=0.4) for azimuth in np.linspace(0, 1.5, 6)]
    leaning_up = np.array([math.sin(0.5), 0, math.cos(0.5)])
    assert leaning(cameras, leaning_up) == pytest.approx(0.5, abs=0.03)
    assert leaning(cameras, np.array([0, 0, 1.0])) < 0.03
    alike = [level(0.3, roll, pitch=0.6) for roll in (-0.1, 0.1)]  # they do not determine the pitch
    assert leaning(alike, leaning_up) == 0


def test_a_model_that_is_not_reliable_has_doubts():
    points, camera = np.zeros((400, 3)), fs.Camera.pinhole(640, 480, 500, 500, 320, 240)
    points[:, 2] = 2
    pixels, track = camera.project(points) + 0.3, np.arange(400)
    names = tuple("abcdefgh")

    def doubts(points=points, corners=0.3, error=0.001, lean=0.0):
        model = Model(
            names,
            (camera,),
            points,
            points.astype(np.uint8),
            (pixels[: len(points)],),
            (track[: len(points)],),
        )
        adjusted = Adjustment(1.0, error, {}, corners, (), (), {})
        frame = world_frame([level(0.2)], 1.0)
        return Captured(
            Written(Path(), (), ()), 8, model, frame, adjusted, (), (), (), error, 0.0, lean
        ).doubts

    assert doubts() == []
    assert "only 100 points in 8 photographs" in doubts(points[:100])[0]
    assert "corners of tags are 2.1 px" in doubts(corners=2.06)[0]
    assert "standard error of 3 %" in doubts(error=0.03)[0]
    assert "30 degrees from that of the cameras" in doubts(lean=math.radians(30))[0]


@pytest.mark.parametrize("axis", range(3))
def test_the_tag_of_up_is_exactly_vertical_and_at_the_origin(axis):
    """On a wall upright (its y axis), sideways (x) or flat (z); the model is turned and scaled."""
    model = rigid_matrix((0.3, -2, 1), (0.5, 0.4, -0.2, 0.7))
    tag = np.eye(4)
    tag[:3, :3] = np.roll(np.eye(3), axis + 1, axis=1)  # its `axis` is z of the world
    tag[:3, :3] = quaternion_to_matrix(np.array([1, 0, 0, 0.1])) @ tag[:3, :3]
    cameras = [level(azimuth, roll=0.1, pitch=0.3) for azimuth in (0.0, 0.4, 1.0)]
    turned = [each.with_pose(each.world_to_camera @ np.linalg.inv(model)) for each in cameras]
    frame = world_frame(turned, 3.0, model @ tag, vertical=True)
    placed = frame.pose(model @ tag)
    np.testing.assert_allclose(placed[:3, axis], (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(placed[:3, 3], 0, atol=1e-12)
    before = [np.linalg.norm(a.position - b.position) for a, b in pairwise(cameras)]
    world = [frame.camera(each) for each in turned]
    after = [np.linalg.norm(a.position - b.position) for a, b in pairwise(world)]
    np.testing.assert_allclose(after, 3 * np.array(before), rtol=1e-9)
    np.testing.assert_allclose(frame.points(model[None, :3, 3] + 0)[0], placed[:3, 3], atol=1e-12)


def test_the_region_of_a_tag_is_masked_and_its_inks_are_measured():
    tag = PlacedMarker(fs.marker("apriltag:36h11:5", 0.16, black=(0.2, 0.1, 0.1), white=(0.8, 0.9, 0.7)))
    camera = fs.Camera.look_at(121, 91, 0.4, (0.1, 0.05, -0.6), (0, 0, 0))
    frame = fs.Renderer("reference").render(tag.cloud(), fs.Capture(camera, outputs=("rgb", "alpha")))
    region = marker_mask(box_of(tag), camera, 1.0)
    assert region[frame["alpha"] > 0.01].all()
    rim = cv2.dilate((frame["alpha"] > 0.5).astype(np.uint8), np.ones((7, 7))) == 0
    assert not region[rim].any()
    behind = camera.with_pose(position=(0, 0, 0.6), target=(0, 0, 0))
    assert not marker_mask(box_of(tag), behind, 1.0).any()
    dark, light = module_colors(tag, (255 * frame["rgb"]).round().astype(np.uint8), camera)
    np.testing.assert_allclose(dark, (0.2, 0.1, 0.1), atol=0.02)
    np.testing.assert_allclose(light, (0.8, 0.9, 0.7), atol=0.02)
    corner = (box_of(tag) @ (1, -1, 0, 1))[:3]
    np.testing.assert_allclose(corner, (0.1, -0.1, 0), atol=1e-12)  # with the quiet zone


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tag": ("apriltag:36h11:5",)}, "--tag must be a marker spec and the edge"),
        ({"tag": ("apriltag:36h11:5=0.1", "tag36h11:5=0.2")}, "given once, got 0.1 and 0.2 m"),
        (
            {"tag": ("apriltag:36h11:5=0",)},
            r"--tag must be .* 0\.001 to 100 metres, got 'apriltag:36h11:5=0'",
        ),
        ({"tag": ("apriltag:36h11:5=1e-9",)}, "--tag must be"),
        ({"tag": ("apriltag:36h11:5=nan",)}, "--tag must be"),
        ({"tag": ("charuco:7x5:4x4_50=0.2",)}, "--tag must be of a detected kind"),
        ({"lens": "wide"}, "unknown lens 'wide'"),
        ({"frames": 2}, "--frames must be"),
        ({"tag": ("qr:a=1",), "scale": "a:1:1,b:2:2=1"}, "--scale must be given without --tag"),
    ],
)
def test_wrong_settings_are_one_clear_line(options, message):
    with pytest.raises(fs.InputError, match=message):
        parse_tags(CaptureSettings(**options).tag)


def test_a_tag_has_many_specs():
    tags = parse_tags(["apriltag:36h11:5=0.16", "qr:a=0.2"])
    assert same_tag(tags, fs.marker("tag36h11:5", 1.0)) is tags["apriltag:36h11:5"]
    assert same_tag(tags, fs.marker("aruco:4x4_50:5", 1.0)) is None
    assert same_tag(tags, fs.marker("qr-v2-L:a", 1.0)) is tags["qr:a"]


def test_two_picked_pixels_give_the_scale():
    """In two slanted planes, at pixels between features, one of them wrong, through a lens."""
    rng, lens = np.random.default_rng(0), BrownConrady(k1=-0.1)
    camera = fs.Camera.look_at(640, 480, 1.0, (0.3, 0.2, -2), (0.2, 0.1, 0))
    camera = fs.Camera.pinhole(640, 480, 500, 510, 320, 240, camera.world_to_camera, lens=lens)
    x, y = rng.uniform(-0.9, 0.9, (2, 400))
    points = np.stack([x, y, np.where(x < 0, 0.5 * x + 0.2 * y, 1 - 0.3 * x)], 1)
    ends = np.array([[-0.4, 0.1, -0.18], [0.5, -0.2, 0.85]])
    points = points[(np.linalg.norm(points[:, None] - ends, axis=2) > 0.025).all(1)]
    nearest = int(np.argmin(np.linalg.norm(points - ends[0], axis=1)))
    pixels, track = camera.project(points), np.arange(len(points))
    points[nearest] *= 0.8  # a wrong point
    model = Model(("a.jpg",), (camera,), points, np.zeros(points.shape, np.uint8), (pixels,), (track,))
    (x, y), (u, v) = camera.project(ends)
    length = float(np.linalg.norm(ends[0] - ends[1]))
    scale, error = scale_of(model, *parse_scale(f"A.JPG:{x}:{y},a.tif:{u}:{v}={3 * length}"))
    assert scale == pytest.approx(3, rel=1e-4)
    assert error < 1e-3
    moved = points + 0.01 * rng.normal(size=points.shape) * (0, 0, 1)
    noisy = Model(("a.jpg",), (camera,), moved, np.zeros(points.shape, np.uint8), (pixels,), (track,))
    scale, error = scale_of(noisy, *parse_scale(f"a.jpg:{x}:{y},a.jpg:{u}:{v}={3 * length}"))
    assert 0.0005 < error < 0.02
    assert abs(scale / 3 - 1) < 3 * error
    with pytest.raises(InputError, match=r"among features, got a\.jpg:0:0 with the nearest at"):
        scale_of(model, *parse_scale(f"a.jpg:0:0,a.jpg:{u}:{v}=5"))
    with pytest.raises(InputError, match=r"unknown photograph with a camera, of --scale, 'c\.jpg'"):
        scale_of(model, *parse_scale(f"a.jpg:{x}:{y},c.jpg:1:1=5"))
    with pytest.raises(InputError, match="two different points"):
        parse_scale("a.jpg:1:1,a.jpg:1:1=2")
    for text in (
        "a.jpg:nan:1,b.jpg:2:2=1",
        "a.jpg:1:1,b.jpg:2:2",
        "a.jpg:1:1=2",
        "a.jpg:1:1,b.jpg:2:2=0",
        "a:b:c,d:1:2=3",
    ):
        with pytest.raises(InputError, match="--scale must be two pixels"):
            parse_scale(text)


@pytest.mark.parametrize("speed", [0.0, 0.01])
def test_a_rolling_shutter_of_moving_cameras_is_found(speed):
    """Cameras at the middle of the readout, each with its own motion; 0.3 pixels of noise."""
    rng = np.random.default_rng(0)
    points, cameras, collected = rng.uniform((-1, -1, -0.5), (1, 1, 0.5), (300, 3)), [], []
    for _ in range(6):
        position = rng.uniform((-1, -0.6, -3.2), (1, 0.6, -2.8))
        cameras.append(fs.Camera.look_at(640, 480, 1.0, position, (0, 0, 0)))
        pixels, motion = cameras[-1].project(points), rng.normal(0, speed, 3)
        for _ in range(3):  # a row's time depends on where the point is in the image
            times = pixels[:, 1] / 480 - 0.5
            late = (points[:, None] - motion * times[:, None, None]).reshape(-1, 3)
            pixels = cameras[-1].project(late)
        collected.append(pixels + rng.normal(0, 0.3, pixels.shape))
    tracks = tuple(np.arange(300) for _ in cameras)
    model = Model(
        tuple("abcdef"), tuple(cameras), points, np.zeros((300, 3), np.uint8), tuple(collected), tracks
    )
    share, displaced = readout_motion(model)
    assert (share > MIN_FRACTION and displaced > MIN_DISPLACEMENT) == (speed > 0)
    if speed:
        assert displaced == pytest.approx(585 / 3 * 1.3 * speed, rel=0.5)


def test_without_pycolmap_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install 'fidsplat\[capture\]'"):
        photographs_to_scene(tmp_path, tmp_path / "scene")


def exif(order, orientation):
    """A segment with orientation and focal length."""
    word = {"<": "little", ">": "big"}[order]

    def number(value, size):
        return value.to_bytes(size, word)

    def entry(tag, kind, value):
        return number(tag, 2) + number(kind, 2) + number(1, 4) + value

    first = (
        number(2, 2) + entry(0x0112, 3, number(orientation, 2) + b"\0\0") + entry(0x8769, 4, number(38, 4))
    )
    second = number(1, 2) + entry(0x920A, 5, number(56, 4))
    tiff = {"<": b"II", ">": b"MM"}[order] + number(42, 2) + number(8, 4) + first + b"\0" * 4
    tiff += second + b"\0" * 4 + number(43, 4) + number(10, 4)
    return b"\xff\xe1" + (len(tiff) + 8).to_bytes(2, "big") + b"Exif\0\0" + tiff


@pytest.mark.parametrize("order", "<>")
def test_exif_is_kept_with_upright_pixels(order, tmp_path):
    image = np.zeros((16, 32, 3), np.uint8)
    image[:8] = 255
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    rotated = jpeg[:2] + exif(order, 6) + jpeg[2:]
    actual = read_exif(rotated)
    assert (actual.orientation, actual.focal_length) == (6, (4.3,))
    (tmp_path / "a.jpg").write_bytes(rotated)
    assert read_image(tmp_path / "a.jpg").shape == (32, 16, 3)  # OpenCV reads the orientation too
    upright = with_exif(jpeg, actual)
    again = read_exif(upright)
    assert (again.orientation, again.focal_length) == (1, (4.3,))
    (tmp_path / "b.jpg").write_bytes(upright)
    np.testing.assert_array_equal(read_image(tmp_path / "b.jpg").shape, image.shape)
    (tmp_path / "upright copies").mkdir()
    files = [tmp_path / name for name in ("a.jpg", "b.jpg")]
    (tmp_path / "d.jpg").write_bytes(rotated)
    copy_photos([*files, tmp_path / "d.jpg"], tmp_path / "upright copies", lambda step, fraction: None)
    copied = read_image(tmp_path / "upright copies" / "a.jpg")
    np.testing.assert_allclose(copied, read_image(tmp_path / "a.jpg"), atol=3)
    assert read_exif((tmp_path / "upright copies" / "a.jpg").read_bytes()).orientation == 1
    (tmp_path / "B.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (tmp_path / "twice").mkdir()
    with pytest.raises(
        InputError, match=r"differ before the suffix by more than case, got b\.jpg and B\.png"
    ):
        copy_photos([*files, tmp_path / "B.png"], tmp_path / "twice", lambda step, fraction: None)
    (tmp_path / "c.jpg").write_bytes(rotated[: len(rotated) // 2])
    with pytest.raises(InputError, match=r"got 2 of 3: cannot read .*c\.jpg as an image; it is truncated"):
        copy_photos([*files, tmp_path / "c.jpg"], tmp_path / "twice", lambda step, fraction: None)
    # portrait and landscape have different cameras
    assert camera_groups(tmp_path / "upright copies") == [["a.jpg", "d.jpg"], ["b.jpg"]]
    for damaged in (rotated[:40], jpeg, b"", rotated.replace(b"II", b"XX").replace(b"MM", b"XX")):
        assert read_exif(damaged).orientation in (1, 6)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("orientation", [3, 6, 7])
def test_copies_are_upright_for_colmap_too(suffix, orientation, tmp_path):
    """COLMAP ignores the orientation; Pillow's `exif_transpose` applies it."""
    images = pytest.importorskip("PIL.Image", reason="Pillow rotates by EXIF; pip install pillow")
    tags, values = images.Exif(), np.zeros((16, 32, 3), np.uint8)
    tags[ORIENTATION], values[:4], values[:, :6, 0] = orientation, 255, 90
    source, folder = tmp_path / f"a.{suffix}", tmp_path / "copies"
    images.fromarray(values).save(source, exif=tags)
    folder.mkdir()
    copy_photos([source], folder, lambda step, fraction: None)
    (copy,) = folder.iterdir()
    with images.open(source) as given, images.open(copy) as image:
        upright = importlib.import_module("PIL.ImageOps").exif_transpose(given)
        assert image.size == upright.size
        assert np.abs(np.asarray(image, int) - np.asarray(upright, int)).mean() < 12


def test_sharp_frames_at_equal_steps_are_chosen():
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (120, 400, 3), np.uint8), (0, 0), 1.5)
    shifts = [0] * 10 + [2 * i for i in range(1, 61)]  # still, then sideways by 1.25 % of the width
    frames = [wall[:, shift : shift + 160] for shift in shifts]
    blurred = set(range(0, 70, 3))
    frames = [cv2.GaussianBlur(f, (0, 0), 2) if i in blurred else f for i, f in enumerate(frames)]
    sharpness, motion = np.array(list(measure_frames(frames))).T
    np.testing.assert_allclose(motion[12:], 2 / 160, atol=0.001)
    chosen = choose_frames(sharpness, motion, 20)
    assert len(chosen) == 20
    assert not blurred & set(chosen)
    assert np.diff(chosen[1:]).max() <= 5  # 3 frames in each part
    assert 36 <= len(choose_frames(sharpness, motion, 100)) <= 40  # 60 x 0.0125 / 0.02
    assert len(choose_frames(sharpness[:10], motion[:10], 100)) == 1
