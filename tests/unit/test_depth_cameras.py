"""Depth cameras: errors by distance, reflectance and incidence, edges, shadows and holes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from depth_cameras import PUBLISHED  # benchmarks/depth_cameras.py

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.stereo import disparity_of
from fidsplat.scenes import PlacedMarker
from fidsplat.sim.depth_cameras import ActiveStereo, StructuredLight, TimeOfFlight, depth_camera
from fidsplat.util.response import to_colors

BACKEND = "opencl"  # for the fixture `renderer`


def board(z: float, grey: float = 0.9, tilt: float = 0.0, left: float = -9.0) -> fs.SplatCloud:
    """A board at a distance, from x = left to the right, rotated about the vertical by radians."""
    quaternion = [math.cos(tilt / 2), 0, math.sin(tilt / 2), 0]
    color = to_colors(np.full((1, 3), grey), "srgb")
    box = fs.SplatCloud([[left + 9.0, 0, z]], [quaternion], [[9.0, 9.0]], [1.0], colors=color)
    return box.with_boxes()


def pinhole(focal: float) -> fs.Camera:
    return fs.Camera.pinhole(96, 64, focal, focal, 48.0, 32.0)


def test_noise_of_time_of_flight_is_that_of_its_light(renderer):
    device, camera = TimeOfFlight(), pinhole(500.0)
    for z in (0.8, 1.5, 3.0):  # the middle of the image is within 20 % of the published curve
        actual = device.measure(renderer, fs.Scene([board(z)]), camera)[:, 24:72]
        assert (actual - z).std() == pytest.approx(PUBLISHED["azure-kinect"](z), rel=0.2)
    for z, grey, tilt in ((0.8, 0.9, 0.0), (2.5, 0.9, 0.0), (1.5, 0.2, 0.0), (1.5, 0.9, 1.0)):
        scene = fs.Scene([board(z, grey, tilt)])
        true = replace(device, noise=0.0, floor=0.0).measure(renderer, scene, camera)
        actual = device.measure(renderer, scene, camera)
        light = grey * math.cos(tilt) / z**2
        expected = math.sqrt(device.floor**2 + device.noise**2 / light)
        middle = np.s_[:, 40:56]  # where the tilted board is near its distance
        assert true[32, 48] == pytest.approx(z, rel=0.01)
        assert (actual - true)[middle].std() == pytest.approx(expected, rel=0.1)
        assert np.array_equal(actual, device.measure(renderer, scene, camera))
        assert not np.array_equal(actual, device.measure(renderer, scene, camera, seed=1))
    black = fs.Scene([board(3.0, 0.05)])
    assert not device.measure(renderer, black, camera).any()
    assert not device.measure(renderer, fs.Scene([board(4.0)]), camera).any()


def test_flying_pixels_are_the_phase_of_the_mixed_light(renderer):
    camera = pinhole(300.0)
    near, far = 1.0, 1.3
    left = (1 / 3) / 300.0 * near  # the near board covers two thirds of the column right of the centre
    scene = fs.Scene([board(near, left=left), board(far)])
    device = TimeOfFlight(noise=0.0, floor=0.0)
    row = device.measure(renderer, scene, camera)[32]
    wave = 4 * math.pi * device.frequency / 299_792_458
    mixed = sum(share / z**2 * np.exp(1j * wave * z) for share, z in ((2 / 3, near), (1 / 3, far)))
    assert row[48] == pytest.approx(np.angle(mixed) / wave + 2 * math.pi / wave, abs=1e-3)
    assert row[47] == pytest.approx(far, abs=1e-3)
    assert row[49] == pytest.approx(near, abs=1e-3)


def test_structured_light_follows_the_published_error_and_casts_a_shadow(renderer):
    device, camera = StructuredLight(), pinhole(580.0)
    for z in (1.0, 2.0, 3.0):
        actual = device.measure(renderer, fs.Scene([board(z)]), camera)[:, :90]
        assert (actual - z)[actual > 0].std() == pytest.approx(PUBLISHED["kinect-v1"](z), rel=0.2)
    calm = replace(device, noise=0.0, lateral=0.0, step=0.0)
    for tilt in (30, 50, 60):
        wall, middle = fs.Scene([board(1.5, tilt=math.radians(tilt))]), np.s_[:, 40:56]
        actual, true = (each.measure(renderer, wall, camera)[middle] for each in (device, calm))
        assert (actual - true).std() == pytest.approx(PUBLISHED["kinect-v1"](1.5, tilt), rel=0.2)
    scene = fs.Scene([board(1.0, left=0.0), board(1.5)])
    row = calm.measure(renderer, scene, camera)[32]
    shadow = 580.0 * device.baseline * (1 / 1.0 - 1 / 1.5)
    holes = np.flatnonzero(row[:90] == 0)
    assert len(holes) == pytest.approx(shadow, abs=1.5)
    assert holes[-1] == 47
    assert row[50:90] == pytest.approx(1.0, abs=1e-4)
    tilted = calm.measure(renderer, fs.Scene([board(1.5, tilt=math.radians(75))]), camera)
    assert not tilted[:, 40:56].any()


def test_the_given_camera_replaces_the_motion_of_the_scene(renderer):
    """A depth step; the projector next to the camera casts a shadow at it."""
    scene = fs.Scene([board(1.0, left=0.0), board(1.5)])
    back = np.eye(4)
    back[2, 3] = 0.5
    moving = replace(scene, camera=pinhole(580.0), camera_motion=fs.Trajectory([0.0, 1.0], [back, back]))
    for device in (TimeOfFlight(), StructuredLight(), ActiveStereo()):
        expected, actual = (device.measure(renderer, each, pinhole(580.0)) for each in (scene, moving))
        np.testing.assert_array_equal(actual, expected)


def test_disparities_of_shifted_noise_are_unbiased():
    """A band-limited texture, shifted by fractions of a pixel in closed form."""
    rng = np.random.default_rng(0)
    waves = rng.uniform(0.1, 1.0, (60, 1, 1)), rng.uniform(-1, 1, (60, 1, 1)), rng.uniform(0, 6.3, (60, 1, 1))
    y, x = np.mgrid[0:64, 0:128].astype(float)

    def image(shift: float) -> np.ndarray:
        light = np.sin(waves[0] * (x + shift) + waves[1] * y + waves[2]).sum(0)
        return np.rint(np.clip(128 + 12 * light, 0, 255)).astype(np.uint8)

    for shift in (9.0, 9.3, 9.5, 9.8):
        actual = disparity_of(image(0.0), image(shift), 32)[8:-8, 24:-8]
        assert (actual > 0).mean() > 0.99
        assert actual[actual > 0].mean() == pytest.approx(shift, abs=0.01)
        assert actual[actual > 0].std() < 0.03


def test_active_stereo_matches_its_pattern(renderer):
    camera = fs.Camera.pinhole(256, 96, 424.0, 424.0, 128.0, 48.0)
    device = ActiveStereo()
    for z in (0.5, 1.0, 2.0, 3.0):  # without 0.5 % at both ends, as librealsense's depth-quality tool
        wall, spreads = fs.Scene([board(z)]), []
        for seed in range(8):
            actual = np.sort(device.measure(renderer, wall, camera, seed)[16:-16, 68:-68], axis=None)
            assert (actual > 0).mean() > 0.98
            assert abs(np.median(actual) - z) < 0.06 * z**2 / (424.0 * device.baseline)  # pixels of disparity
            spreads.append(actual[len(actual) // 200 : -len(actual) // 200].std())
        assert np.mean(spreads) == pytest.approx(PUBLISHED["d435"](z), rel=0.2)
    # without the pattern a blank wall has nothing to match
    wall = fs.Scene([board(1.5)])
    blind = replace(device, pattern=0.0).measure(renderer, wall, camera)[16:-16, 60:-40]
    right = np.abs(blind - 1.5) < 0.05
    assert right.mean() < 0.2
    # the background left of a near board is occluded in the right camera
    step = fs.Scene([board(1.0, left=0.0), board(1.6)])
    row = device.measure(renderer, step, camera)[48]
    occluded = 424.0 * device.baseline * (1 / 1.0 - 1 / 1.6)
    assert (np.abs(row[128 - int(occluded) : 126] - 1.6) > 0.1).mean() > 0.6
    assert np.abs(row[140:240] - 1.0).max() < 0.05


def test_wrong_depth_cameras_are_refused(renderer):
    with pytest.raises(fs.InputError, match=r"unknown depth camera 'd453' .did you mean 'd435'"):
        depth_camera("d453")
    with pytest.raises(fs.InputError, match=r"unknown depth camera \[\]; known"):
        depth_camera([])
    with pytest.raises(fs.InputError, match=r"renderer must be a Renderer, got 'opencl'; fs\.Renderer"):
        TimeOfFlight().measure("opencl", fs.Scene([board(1.0)]), pinhole(9.0))
    with pytest.raises(fs.InputError, match="max_disparity must be a multiple of 16"):
        ActiveStereo(max_disparity=50)
    with pytest.raises(fs.InputError, match="far must be a distance in metres above near"):
        TimeOfFlight(near=2.0, far=1.0)
    with pytest.raises(fs.InputError, match="pinhole without lens"):
        StructuredLight().measure(renderer, fs.Scene([board(1.0)]), fs.Camera.fisheye(32, 32, 2.0))


def test_render_writes_what_a_depth_camera_measures(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tag = fs.marker("apriltag:16h5:1", 9.0)
    pose = np.eye(4)
    pose[2, 3] = 1.0
    scene = fs.Scene(markers=[PlacedMarker(tag, pose)], camera=pinhole(100.0))
    scene.save("scene.toml")
    assert main(["render", "scene.toml", "-o", "out", "--depth-camera", "kinect-v1"]) == 0
    depth = np.load("out/kinect-v1.npy")
    assert depth.shape == (480, 640)
    assert np.median(depth) == pytest.approx(1.0, abs=0.01)
