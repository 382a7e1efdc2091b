"""Combinations of effects: those that are right, against the reference, and those that are refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, against_reference, random_splats
from sampling import SAMPLES, alternate

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.effects import select
from fidsplat.selftest.agreement import FrameSpec, compare

SIZE = (41, 29)
CLOUD = random_splats(120, 21, depth=(0.5, 5.0), scale=(0.02, 0.4))
BOXES = fs.SplatCloud.concatenate(
    [random_splats(60, 22, depth=(0.5, 5.0), scale=(0.02, 0.4)).with_boxes(), CLOUD]
)
PANORAMA = fs.Panorama(np.random.default_rng(5).random((8, 16, 3)).astype(np.float32))
SKY = fs.Gradient((0.2, 0.4, 0.9), (0.4, 0.3, 0.1))
FOG = fs.Fog(0.2, (0.6, 0.65, 0.7))
SENSOR = fs.Sensor(exposure=1.5, vignetting=(-0.4, 0.0, 0.1), response="srgb")
PLAIN = fs.Camera.pinhole(*SIZE, 40.0, 40.0, 20.0, 14.0)
CAMERAS = {
    "distortion": fs.Camera.pinhole(*SIZE, 40.0, 40.0, 20.0, 14.0, lens=fs.BrownConrady(-0.2, 0.05)),
    "fisheye": fs.Camera.fisheye(*SIZE, math.radians(170)),
    "panorama": fs.Camera.equirectangular(*SIZE),
    "parallel": fs.Camera.orthographic(*SIZE, 4.0),
}
ALONG = {name: camera for name, camera in CAMERAS.items() if name != "distortion"}
OUTPUTS = ("depth", "distance", "depth_first", "normal_world", "splat_id", "blended")
BLUR = fs.Shutter(exposure_time=0.4, sub_poses=3)
WARP = next((info.name for info in fs.devices() if info.usable and info.name.startswith("warp")), None)
ROLLING = fs.Shutter(time=0.1, exposure_time=0.2, sub_poses=2, readout=0.4, rows_per_band=8)


def sliding(time):
    """A camera that moves to the right and does not turn."""
    pose = np.eye(4)
    pose[0, 3] = -0.5 * time
    return pose


def rotating(time):
    """A camera that turns about its z axis."""
    pose, angle = np.eye(4), 0.6 * time
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return pose


def assert_agrees(renderer, **image):
    differences = against_reference(renderer, FrameSpec(**{"cloud": CLOUD, **image}))
    assert all(difference.agrees for difference in differences), differences


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_outputs_and_sensors_behind_every_lens(renderer, camera):
    assert_agrees(renderer, camera=camera, outputs=("rgb", *OUTPUTS), sensor=SENSOR)


@pytest.mark.parametrize(("camera", "samples"), alternate(CAMERAS, SAMPLES))
def test_fog_and_distances_behind_lenses(renderer, camera, samples):
    outputs = ("rgb", "distance", "distance_median", "distance_first")
    quality = fs.Quality(samples=samples)
    assert_agrees(renderer, camera=camera, outputs=outputs, quality=quality, fog=FOG)


# where test_outputs_and_sensors_behind_every_lens has compiled it
@pytest.mark.parametrize("name", ALONG)
def test_distances_are_depths_where_depths_are_along_the_ray(renderer, name):
    frame = renderer.render(CLOUD, ALONG[name], ("rgb", *OUTPUTS), sensor=SENSOR)
    assert frame["depth"].max() > 0.5
    assert np.array_equal(frame["depth"], frame["distance"])


@pytest.mark.parametrize(
    ("around", "shutter"),
    alternate(
        {name: name for name in ("fog", "sky", "panorama", "boxes", "pixel")},
        {"blur": BLUR, "rolling": ROLLING},
    ),
)
def test_effects_of_the_image_under_a_shutter(renderer, around, shutter):
    cloud = BOXES if around == "boxes" else CLOUD
    quality = fs.Quality(lowpass="pixel" if around == "pixel" else "screen")
    behind = {"sky": SKY, "panorama": PANORAMA}.get(around, (0.1, 0.2, 0.3))
    fog = FOG if around == "fog" else None
    motion = fs.Motion(rotating, {0: sliding})
    outputs = ("rgb", "alpha", "distance", "depth_median", "splat_id", "normal_world")
    capture = fs.Capture(PLAIN, outputs, quality, behind, motion, shutter, SENSOR, fog)
    frame = renderer.render(cloud, capture)
    features, view = prepare(cloud, capture)
    reference = ReferenceBackend()
    expected = reference.pipeline(features).render_view(reference.upload(cloud), view).arrays_of(0)
    differences = compare(frame, expected, outputs)
    assert all(difference.agrees for difference in differences), differences


def test_fog_is_averaged_over_the_poses_of_a_shutter(renderer):
    """Fog in front of a wall that is visible in one of two sub-poses counts half."""
    wall = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[50, 50]], [1.0], colors=[[0, 0, 0]])

    def away(time):
        pose = np.eye(4)
        pose[2, 3] = 0.0 if time < 0 else 1e6
        return pose

    def middle(**when):
        camera = replace(PLAIN, far=100.0)
        motion = {} if not when else {"motion": fs.Motion(away), "shutter": fs.Shutter(**when)}
        return renderer.render(wall, camera, ("rgb", "depth"), fog=FOG, **motion)["rgb"][14, 20].astype(float)

    near, none, both = middle(), np.array(FOG.color), middle(exposure_time=1.0, sub_poses=2)
    assert (near < none - 0.1).all()
    assert np.allclose(both, (near + none) / 2, atol=1e-5)


@pytest.mark.parametrize(
    ("camera", "behind", "samples"), alternate(CAMERAS, {"sky": SKY, "panorama": PANORAMA}, SAMPLES)
)
def test_backgrounds_behind_every_lens(renderer, camera, behind, samples):
    image = {"camera": camera, "background": behind, "quality": fs.Quality(samples=samples)}
    assert_agrees(renderer, outputs=(*ALL_OUTPUTS, "normal_world"), **image)


@pytest.mark.skipif(WARP is None, reason="no Warp device here")
def test_warp_names_what_it_lacks():
    features = replace(select(CLOUD, fs.Capture(PLAIN)), outputs=("overdraw",))
    with pytest.raises(fs.DeviceError, match=r"warp.*no overdraw; use an OpenCL device"):
        fs.Renderer(WARP).backend.pipeline(features)
