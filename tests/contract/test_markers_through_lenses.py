"""A robot localises by tags that it sees through its lens and shutter: within 1 % of the distance, where a
perfect print of the tag under the same effects allows it."""

import math

import numpy as np
import pytest
from ideal_effects import assert_as_good, ideal_image
from sampling import alternate

import fidsplat as fs
from fidsplat.vision.detect import detect
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.undistort import undistort

BACKEND = "opencl"
pytestmark = pytest.mark.usefixtures("optimised")
SIZE, SPEC = 0.4, "apriltag:36h11:5"
DENSE = fs.Quality(lowpass="none", samples=2)
GREY = (0.5, 0.5, 0.5)


def tag_at(position, turn):
    """A tag whose front looks at the origin from `position`, turned about the vertical by `turn` more."""
    x, _, z = position
    half = (math.atan2(x, z) + turn) / 2
    return fs.scenes.PlacedMarker(
        fs.marker(SPEC, size=SIZE, mixture="fitted"),
        np.array(pose_of(position, [math.cos(half), 0.0, math.sin(half), 0.0])),
    )


def pose_of(position, quaternion):
    from fidsplat.splats.rotations import rigid_matrix

    return rigid_matrix(position, quaternion)


CASES = {
    "pinhole": (fs.Camera.pinhole(480, 360, 400, 400, 240, 180), (0.4, -0.2, 1.6)),
    "distortion": (
        fs.Camera.pinhole(480, 360, 300, 300, 240, 180, lens=fs.BrownConrady(-0.28, 0.07, p1=1e-3)),
        (0.6, -0.3, 1.4),
    ),
    "fisheye, to the side": (fs.Camera.fisheye(640, 640, math.radians(200)), (1.5, 0.1, -0.05)),
    "panorama, behind": (fs.Camera.equirectangular(1280, 640), (0.5, 0.2, -1.4)),
}


def eight_bits(rgb):
    return np.clip(np.round(np.asarray(rgb) * 255), 0, 255).astype(np.uint8)


def images(renderer, placed, camera, **effects):
    """Image of the splats, and image of the ideal plane with the same effects."""
    scene = fs.Scene([], camera, [placed], background=GREY, quality=DENSE)
    rendered = renderer.render(scene, **effects)["rgb"]
    ideal = ideal_image(scene.markers[0], camera, DENSE.samples, GREY, **effects)
    return eight_bits(rendered), eight_bits(ideal)


def corners_in(image):
    """Of tag 5; None if it is not found."""
    detections = detect(image, families=("36h11",), qr=False)
    assert [tag.id for tag in detections] in ([], [5])
    return detections[0].corners if detections else None


def assert_found(renderer, name, turn, **effects):
    """After undistortion, where it is to 1 % of the distance, which the ideal plane allows here."""
    camera, position = CASES[name]
    placed = tag_at(position, turn)
    flat = fs.Camera.look_at(360, 360, math.radians(40), camera.position, position)
    errors = []
    for image in images(renderer, placed, camera, **effects):
        corners = corners_in(undistort(image, camera, flat))
        assert corners is not None
        pose = np.linalg.inv(flat.world_to_camera) @ marker_pose(corners, SIZE, flat)
        errors.append(pose_error(pose, placed.pose)[0])
    assert_as_good(*errors, np.linalg.norm(position))
    assert errors[1] < 0.01 * np.linalg.norm(position)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("turn_deg", [0, 30])
def test_a_tag_is_found_where_it_is(renderer, name, turn_deg):
    assert_found(renderer, name, math.radians(turn_deg))


@pytest.mark.parametrize("name", CASES)
def test_a_tag_that_moves_is_found_in_blur_and_noise_through_every_lens(renderer, name):
    """It turns about the camera by 0.4 rad a second, up to 2 px during the exposure; light falls off, and
    values have a noise of up to 5 of 255 grey levels."""

    def around(time):
        return pose_of((0, 0, 0), (math.cos(0.2 * time), 0, math.sin(0.2 * time), 0))

    assert_found(
        renderer,
        name,
        math.radians(15),
        motion=fs.Motion(None, {1: around}),
        shutter=fs.Shutter(exposure_time=0.01, sub_poses=4),
        sensor=fs.Sensor(vignetting=(-0.3,), full_well=3000, read_noise=10, seed=2),
    )


@pytest.mark.parametrize(
    ("turn_deg", "blurred"), alternate({"0": 0, "30": 30}, {"sharp": False, "blurred": True})
)
def test_parallel_rays_show_where_a_tag_is_across_them_and_its_rotation(renderer, turn_deg, blurred):
    """How far along the rays it is and to which side it leans, they do not show. The affine map from the tag
    to the image has its place, its turn in the image and the cosine of its lean."""
    camera = fs.Camera.orthographic(480, 360, 1.6)
    placed = tag_at((0.3, -0.15, 1.5), math.radians(turn_deg) - math.atan2(0.3, 1.5))
    effects = {}
    if blurred:  # by 2 px, with a noise of up to 5 of 255 grey levels
        motion = fs.Motion(None, {1: lambda time: pose_of((0.7 * time, 0.0, 0.0), (1, 0, 0, 0))})
        effects = {"motion": motion, "shutter": fs.Shutter(exposure_time=0.01, sub_poses=4)}
        effects["sensor"] = fs.Sensor(full_well=3000, read_noise=10, seed=2)
    errors = []
    for image in images(renderer, placed, camera, **effects):
        corners = corners_in(image)
        assert corners is not None
        across = (corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        printed = np.column_stack([placed.marker.corners[:, :2], np.ones(4)])
        (*columns, place), *_ = np.linalg.lstsq(printed, across, rcond=None)
        left, lengths, right = np.linalg.svd(np.transpose(columns))
        lean = math.acos(min(lengths[1] / lengths[0], 1.0))
        turned = left @ right
        errors.append(float(np.linalg.norm(place - placed.pose[:2, 3])))
        assert abs(math.atan2(turned[1, 0], turned[0, 0])) < math.radians(1)
        if turn_deg:  # the cosine is flat at 0
            assert abs(lean - math.radians(turn_deg)) < math.radians(1)
    assert_as_good(*errors, 1.5)
    assert errors[1] < 0.01 * 1.5


@pytest.mark.parametrize("modules", [0.1, 1.0, 4.0])
def test_a_blurred_tag_is_found_wherever_the_ideal_plane_is(renderer, modules):
    """From a tenth of a module, with which all is well, to four, with which no code can be read."""
    camera, position = CASES["pinhole"]
    placed = tag_at(position, 0.3)
    exposure = modules * placed.marker.module / 0.8
    motion = fs.Motion(None, {1: lambda time: pose_of((0.8 * time, 0.0, 0.0), (1, 0, 0, 0))})
    shutter = fs.Shutter(exposure_time=exposure, sub_poses=8)
    errors = []
    for image in images(renderer, placed, camera, motion=motion, shutter=shutter):
        corners = corners_in(image)
        pose = None if corners is None else marker_pose(corners, SIZE, camera)
        errors.append(math.inf if pose is None else pose_error(pose, placed.pose)[0])
    assert_as_good(*errors, np.linalg.norm(position))
    if modules == 0.1:
        assert errors[1] < 0.01 * np.linalg.norm(position)
    if modules == 4.0:
        assert errors[1] == math.inf


@pytest.mark.parametrize("name", CASES)
def test_exact_corners_give_the_exact_pose(name):
    camera, position = CASES[name]
    placed = tag_at(position, 0.4)
    apart, angle = pose_error(marker_pose(camera.project(placed.corners), SIZE, camera), placed.pose)
    assert apart < 1e-6
    assert angle < 1e-6


def test_a_rolling_shutter_shows_the_tag_at_its_rows_time(renderer):
    """The camera turns, so the image is sheared; rows at the tag's height are read at a known time."""
    camera, position = CASES["pinhole"]
    placed = tag_at(position, 0.2)

    def turning(time):
        return pose_of((0, 0, 0), (math.cos(time / 2), 0, math.sin(time / 2), 0))

    readout, errors = 0.03, []
    shutter = fs.Shutter(readout=readout, rows_per_band=4)
    for image in images(renderer, placed, camera, motion=fs.Motion(turning), shutter=shutter):
        corners = corners_in(image)
        assert corners is not None
        then = turning(readout * (corners[:, 1].mean() / camera.height - 0.5))
        errors.append(pose_error(marker_pose(corners, SIZE, camera), then @ placed.pose)[0])
    assert_as_good(*errors, np.linalg.norm(position))
    assert errors[1] < 0.01 * np.linalg.norm(position)


@pytest.mark.parametrize(
    ("wide", "position", "target", "up"),
    [
        (640, (-0.326, -2.038, -0.279), (-0.034, 0.047, 0.0), (0.168, -0.986, 0.3)),
        (640, (0.207, 2.518, -0.624), (0.03, -0.01, 0.0), (0.626, 0.78, 0.3)),
        (640, (0.151, 1.754, -0.223), (0.015, 0.006, 0.0), (-0.021, -1.0, 0.3)),
        (1600, (-0.082, -1.025, -0.525), (0.049, -0.02, 0.0), (-0.233, -0.972, 0.3)),
    ],
)
def test_steep_tags_have_their_corners(renderer, wide, position, target, up):
    """OpenCV's own are 4 to 31 px off here, several of them at once, along the tag's long sides."""
    field = 2 * math.atan(wide / 2 / {640: 1800, 1600: 3500}[wide])
    camera = fs.Camera.look_at(wide, wide * 3 // 4, field, position, target, up)
    placed = fs.scenes.PlacedMarker(fs.marker(SPEC, size=0.16))
    image = eight_bits(renderer.render(fs.Scene([], camera, [placed], background=GREY))["rgb"])
    corners = corners_in(image)
    assert corners is not None
    assert np.linalg.norm(corners - camera.project(placed.corners), axis=1).max() < 0.5


def test_images_that_cannot_be_undistorted():
    camera = CASES["distortion"][0]
    flat = fs.Camera.look_at(64, 48, 1.0, camera.position, (0, 0, 1))
    with pytest.raises(fs.InputError, match="size, 480 x 360 pixels, got 10 x 20"):
        undistort(np.zeros((20, 10), np.uint8), camera, flat)
    elsewhere = fs.Camera.look_at(64, 48, 1.0, (1, 0, 0), (1, 0, 1))
    with pytest.raises(fs.InputError, match="the position of the image's camera"):
        undistort(np.zeros((360, 480), np.uint8), camera, elsewhere)
    with pytest.raises(fs.InputError, match="the camera must have rays from one point, got Orthographic"):
        undistort(np.zeros((48, 64), np.uint8), fs.Camera.orthographic(64, 48, 1.0), flat)
    with pytest.raises(
        fs.InputError, match="lens must have rays from one point, got Orthographic, whose rays are"
    ):
        marker_pose(np.zeros((4, 2)), 0.1, fs.Camera.orthographic(64, 48, 1.0))
