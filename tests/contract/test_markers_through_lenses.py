"""A robot localises by tags that it sees through its lens and shutter: within 1 % of the distance."""

import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.vision.detect import detect
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.undistort import pinhole_towards, undistort

SIZE, SPEC = 0.4, "apriltag:36h11:5"
DENSE = fs.Quality(lowpass="none", samples=3)


def tag_at(position, turn):
    """A tag whose front looks at the origin from `position`, turned about the vertical by `turn` more."""
    x, _, z = position
    half = (math.atan2(x, z) + turn) / 2
    return fs.scenes.PlacedMarker(
        fs.marker(SPEC, size=SIZE),
        np.array(pose_of(position, [math.cos(half), 0.0, math.sin(half), 0.0])),
    )


def pose_of(position, quaternion):
    from fidsplat.rotations import rigid_matrix

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


def assert_found(renderer, name, turn, **effects):
    """After undistortion, where it is to 1 % of the distance."""
    camera, position = CASES[name]
    placed = tag_at(position, turn)
    scene = fs.Scene([], camera, [placed], background=(0.5, 0.5, 0.5), quality=DENSE)
    image = eight_bits(renderer.render(scene, **effects)["rgb"])
    flat = pinhole_towards(camera, position, 360, 360, math.radians(40))
    (found,) = detect(undistort(image, camera, flat), families=("36h11",), qr=False)
    assert found.id == 5
    pose = np.linalg.inv(flat.world_to_camera) @ marker_pose(found.corners, SIZE, flat)
    apart, _ = pose_error(pose, placed.pose)
    print(f"{name}: {100 * apart / np.linalg.norm(position):.2f} % of the distance")
    assert apart < 0.01 * np.linalg.norm(position)


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
        shutter=fs.Shutter(exposure=0.01, sub_poses=4),
        sensor=fs.Sensor(vignetting=(-0.3,), full_well=3000, read_noise=10, seed=2),
    )


@pytest.mark.parametrize("name", CASES)
def test_exact_corners_give_the_exact_pose(name):
    camera, position = CASES[name]
    placed = tag_at(position, 0.4)
    apart, angle = pose_error(marker_pose(camera.project(placed.corners), SIZE, camera), placed.pose)
    assert apart < 1e-6
    assert angle < 1e-6


def test_a_blurred_tag_is_found_in_the_middle_of_its_exposure(renderer):
    camera, position = CASES["pinhole"]
    placed = tag_at(position, 0.3)
    motion = fs.Motion(None, {1: lambda time: pose_of((0.8 * time, 0.0, 0.0), (1, 0, 0, 0))})
    scene = fs.Scene([], camera, [placed], background=(0.5, 0.5, 0.5), quality=DENSE)
    # 4 mm, 1 px: a tenth of a module
    shutter = fs.Shutter(exposure=0.005, sub_poses=5)
    image = eight_bits(renderer.render(scene, motion=motion, shutter=shutter)["rgb"])
    (found,) = detect(image, families=("36h11",), qr=False)
    apart, _ = pose_error(marker_pose(found.corners, SIZE, camera), placed.pose)
    assert apart < 0.01 * np.linalg.norm(position)


def test_a_rolling_shutter_shows_the_tag_at_its_rows_time(renderer):
    """The camera turns, so the picture is sheared; rows at the tag's height are read at a known time."""
    camera, position = CASES["pinhole"]
    placed = tag_at(position, 0.2)

    def turning(time):
        return pose_of((0, 0, 0), (math.cos(time / 2), 0, math.sin(time / 2), 0))

    readout = 0.03
    scene = fs.Scene([], camera, [placed], background=(0.5, 0.5, 0.5), quality=DENSE)
    shutter = fs.Shutter(readout=readout, rows_per_band=4)
    image = eight_bits(renderer.render(scene, motion=fs.Motion(turning), shutter=shutter)["rgb"])
    (found,) = detect(image, families=("36h11",), qr=False)
    middle = found.corners[:, 1].mean()
    then = turning(readout * (middle / camera.height - 0.5))
    apart, _ = pose_error(marker_pose(found.corners, SIZE, camera), then @ placed.pose)
    assert apart < 0.01 * np.linalg.norm(position)


def test_pictures_that_cannot_be_undistorted():
    camera = CASES["distortion"][0]
    flat = pinhole_towards(camera, (0, 0, 1), 64, 48, 1.0)
    with pytest.raises(fs.InputError, match="10 x 20 pixels, but its camera 480 x 360"):
        undistort(np.zeros((20, 10), np.uint8), camera, flat)
    elsewhere = fs.Camera.look_at(64, 48, 1.0, (1, 0, 0), (1, 0, 1))
    with pytest.raises(fs.InputError, match="stand where"):
        undistort(np.zeros((360, 480), np.uint8), camera, elsewhere)
    with pytest.raises(fs.InputError, match="up to 150"):
        pinhole_towards(camera, (0, 0, 1), 64, 48, 3.0)
    with pytest.raises(fs.InputError, match="no directions"):
        marker_pose(np.zeros((4, 2)), 0.1, fs.Camera.orthographic(64, 48, 1.0))
