"""Images through lenses against the reference, which evaluates every splat at every pixel, so that errors
of bounds are visible."""

import math
from dataclasses import replace

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, against_reference, assert_agrees, random_splats, reference_pixels
from sampling import SAMPLES, alternate
from test_agreement import coplanar_cloud

import fidsplat as fs
from fidsplat.backends.view import View
from fidsplat.cameras import BrownConrady, Fisheye
from fidsplat.selftest.agreement import FrameSpec
from fidsplat.splats.rotations import matrix_to_quaternion

POSE = fs.Camera.look_at(64, 48, 1.0, (0.3, 0.2, -0.1), (0.1, 0.0, 3.0)).world_to_camera


def camera_with_lens(lens, width=75, height=62, f=50.0):
    return fs.Camera.pinhole(width, height, f, 1.02 * f, 0.47 * width, 0.52 * height, POSE, lens=lens)


# each coefficient has its own term in the kernels, and in their derivatives
EVERY_TERM = BrownConrady(
    -0.3, 0.1, 0.02, 0.05, 0.03, 0.04, p1=0.01, p2=-0.005, s1=0.01, s2=0.02, s3=-0.01, s4=-0.015
)
CAMERAS = {
    "distortion": camera_with_lens(EVERY_TERM),
    "pincushion": camera_with_lens(BrownConrady(0.4, 0.1)),
    # the corners lie beyond the fold
    "fold": camera_with_lens(BrownConrady(-0.35)),
    "fisheye 200": fs.Camera.fisheye(70, 66, math.radians(200), POSE),
    "fisheye": camera_with_lens(Fisheye(0.1, -0.05, 0.01, 0.004), f=35.0),
    "panorama": fs.Camera.equirectangular(110, 55, POSE),
    "parallel": fs.Camera.pinhole(75, 62, 19.0, 24.0, 36.0, 32.5, POSE, lens=fs.Orthographic()),
}


each_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


@each_camera
@pytest.mark.parametrize("seed", [0, 1])
def test_splats_all_around_the_camera(renderer, camera, seed):
    assert_agrees(renderer, random_splats(200, seed, depth=(-5.0, 6.0)), camera)


@pytest.mark.parametrize("name", ["distortion", "fisheye 200", "panorama", "parallel"])
def test_near_and_far_planes_amid_the_splats(renderer, name):
    """Complete disks are culled at the far plane, fragments at the near plane."""
    camera = replace(CAMERAS[name], near=1.0, far=3.0)
    cloud = random_splats(100, 2, depth=(-3.0, 6.0))
    frame = assert_agrees(renderer, cloud, camera)
    full_frame = renderer.render(cloud, CAMERAS[name], ALL_OUTPUTS)
    assert np.abs(frame["rgb"] - full_frame["rgb"]).max() > 0.1


@pytest.mark.parametrize("name", ["pinhole", "distortion", "fisheye 200", "panorama", "parallel"])
def test_depths_of_a_tilted_wall_are_right_to_a_hundred_thousandth(renderer, name):
    """Without an error bound: nothing is hard here."""
    camera = CAMERAS.get(name, camera_with_lens(None))
    center = np.linalg.inv(camera.world_to_camera) @ (0.1, -0.2, 3.0, 1.0)
    quaternion = (0.9, 0.25, -0.2, 0.1)
    wall = fs.SplatCloud([center[:3]], [quaternion], [(1.5, 1.5)], [1.0], colors=[(1, 1, 1)])
    frame = renderer.render(wall, camera, ALL_OUTPUTS)
    want = reference_pixels(wall, camera, ALL_OUTPUTS, fs.Quality())["depth"]
    inside = frame["alpha"] > 0.1
    assert np.ptp(want[inside]) > 0.3
    assert frame["depth"][inside] == pytest.approx(want[inside], rel=1e-5)


@each_camera
def test_small_splats_of_all_shapes(renderer, camera):
    """Needles included; each at most a few pixels wide, where a bound that is too tight loses most."""
    cloud = random_splats(600, 4, depth=(-4.0, 4.0), scale=(1e-4, 0.2), across=4.0)
    assert_agrees(renderer, cloud, camera, quality=fs.Quality(lowpass="none"))


@each_camera
def test_splats_much_larger_than_the_image(renderer, camera):
    assert_agrees(renderer, random_splats(80, 5, depth=(-4.0, 4.0), scale=(0.1, 30.0)), camera)


RIMS = {
    "beyond edges": ((-0.688, -2.273, -0.912), (0.491, -0.787, 0.375), (-0.703, -0.612, -0.363)),
    "between corners": ((0.147, 0.098, 1.175), (-0.135, -0.467, 0.874), (0.95, 0.189, 0.248)),
}
"""disks (centre, half axes) whose rims a fisheye sees beyond the straight edges, or the corners, of a polygon
around them: found at random, of each kind what a bound without its margin would cut off furthest"""
TO_THE_RIM = fs.Quality(alpha_cutoff=math.exp(-0.5), lowpass="none")
"""opaque disks of one standard deviation, whose rims are visible"""


@pytest.mark.parametrize("name", RIMS)
def test_rims_that_bulge_behind_a_fisheye(renderer, name):
    mean, *axes = np.array(RIMS[name])
    u, v = (axis / np.linalg.norm(axis) for axis in axes)
    v -= (u @ v) * u
    rotation = np.stack([u, v / np.linalg.norm(v), np.cross(u, v / np.linalg.norm(v))], axis=1)
    scales = [[np.linalg.norm(axis) for axis in axes]]
    disk = fs.SplatCloud([mean], [matrix_to_quaternion(rotation)], scales, [1.0], colors=[(1, 1, 1)])
    camera = fs.Camera.fisheye(200, 200, math.radians(200))
    alpha = assert_agrees(renderer, disk, camera, quality=TO_THE_RIM)["alpha"]
    assert (alpha > 0.6).any()


def test_a_disk_whose_middle_a_fisheye_nearly_touches(renderer):
    """All of it is within its radius of the camera, so that it reaches around it: almost half of all rays
    meet it, and the arcs of its bounding polygon are short nevertheless. Found at random."""
    quaternion = (0.0766, 0.5008, 0.8621, -0.0097)
    disk = fs.SplatCloud([(0.0903, 0.0785, 0.0004)], [quaternion], [(1, 1)], [1.0], colors=[(1, 1, 1)])
    camera = fs.Camera.pinhole(95, 69, 35.6, 35.6, -18.6, 19.8, lens=Fisheye())
    alpha = assert_agrees(renderer, disk, camera, quality=TO_THE_RIM)["alpha"]
    assert (alpha > 0.6).any()
    assert (alpha == 0).any()


def test_a_rim_ahead_of_a_disk_that_reaches_behind_the_camera(renderer):
    """A floor, half of it behind: its far end lies between two corners of the polygon that bounds it."""
    c, s = math.cos(math.pi / 16), math.sin(math.pi / 16)
    rotation = np.array([[c, -s, 0], [0, 0, -1], [s, c, 0]])
    floor = fs.SplatCloud(
        [(0, 0.5, 0.3)], [matrix_to_quaternion(rotation)], [(1, 1)], [1.0], colors=[(1, 1, 1)]
    )
    camera = fs.Camera.pinhole(80, 60, 8000.0, 8000.0, 40.0, -3050.0)
    alpha = assert_agrees(renderer, floor, camera, quality=TO_THE_RIM)["alpha"]
    assert (alpha > 0.6).any()
    assert (alpha == 0).any()


@pytest.mark.parametrize(("seed", "depth", "scale"), [(6, 4.0, (0.1, 3.0)), (18, 1.0, (0.05, 0.5))])
def test_rims_in_a_panorama(renderer, seed, depth, scale):
    cloud = random_splats(60, seed, depth=(-depth, depth), scale=scale)
    opaque = fs.SplatCloud(cloud.means, cloud.quats, cloud.scales, np.ones(60), colors=cloud.colors)
    camera = fs.Camera.equirectangular(220, 110, POSE)
    assert_agrees(renderer, opaque, camera, quality=TO_THE_RIM)


@pytest.mark.parametrize(("camera", "samples"), alternate(CAMERAS, SAMPLES))
def test_layers(renderer, camera, samples):
    assert_agrees(renderer, coplanar_cloud(1), camera, quality=fs.Quality(samples=samples))


# test_all_effects of both matrices has them behind every lens
@pytest.mark.parametrize("name", ["distortion", "fisheye", "panorama", "parallel"])
def test_colours_that_depend_on_the_view(renderer, name):
    cloud = random_splats(100, 11, depth=(1, 6), scale=(0.02, 0.4), sh_degree=3)
    assert_agrees(renderer, cloud, CAMERAS[name])


@pytest.mark.parametrize("name", ["fisheye 200", "panorama"])
def test_splats_that_cross_the_rim_seam_and_poles(renderer, name):
    """Splats centred within a few degrees of where the image ends, or of its poles and seam."""
    generator = np.random.default_rng(7)
    polar = np.concatenate([np.radians(generator.uniform(92, 110, 150)), generator.uniform(3.0, math.pi, 50)])
    around = generator.uniform(0, 2 * math.pi, 200)
    around[:50] = generator.choice([0, math.pi / 2, math.pi, 3 * math.pi / 2], 50)
    directions = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=1
    )
    seen = directions * generator.uniform(0.5, 4.0, (200, 1))
    camera = CAMERAS[name]
    means = (seen - POSE[:3, 3]) @ POSE[:3, :3]
    poles = random_splats(60, 8, depth=(-0.05, 0.05), scale=(0.05, 0.5), across=0.05)
    rim = fs.SplatCloud(
        means,
        generator.normal(size=(200, 4)),
        np.exp(generator.uniform(math.log(1e-3), 0, (200, 2))),
        generator.uniform(0.1, 1, 200),
        colors=generator.uniform(0, 1, (200, 3)),
    )
    above = poles.transformed(fs_move(camera.position + POSE[:3, :3].T @ [0, -1.5, 0]))
    assert_agrees(renderer, fs.SplatCloud.concatenate([rim, above]), camera)


def fs_move(position):
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return matrix


def test_outside_the_lens_is_background(renderer):
    camera = CAMERAS["fisheye 200"]
    frame = renderer.render(
        random_splats(100, 3, scale=(1.0, 9.0)),
        camera,
        outputs=ALL_OUTPUTS,
        background=(0.2, 0.4, 0.6),
    )
    x, y = np.meshgrid(np.arange(70) + 0.5 - 35, np.arange(66) + 0.5 - 33)
    outside = np.hypot(x, y) > 35.01
    assert outside.any()
    assert (frame["rgb"][outside] == np.float32([0.2, 0.4, 0.6])).all()
    assert (frame["alpha"][outside] == 0).all()
    assert (frame["label"][outside] == -1).all()
    assert frame["alpha"][~outside].max() > 0.5


@pytest.mark.parametrize("name", ["fold", "fisheye 200"])
def test_outside_of_a_lens_there_is_no_distance_and_no_gradient(renderer, name):
    image = FrameSpec(
        random_splats(60, 3, depth=(1.0, 4.0)),
        CAMERAS[name],
        fs.Quality(samples=2),
        ("rgb", "alpha", "distance", "distance_median"),
        fs.Gradient((0.2, 0.4, 0.9), (0.9, 0.2, 0.1)),
    )
    frame = renderer.render(
        image.cloud, image.camera, image.outputs, image.quality, background=image.background
    )
    rays = View.of(fs.Capture(image.camera, quality=image.quality), np.zeros(3)).raster.rays[..., 0]
    seen = (~np.isnan(rays)).reshape(image.camera.height, 2, image.camera.width, 2).sum((1, 3))
    unseen = seen == 0
    assert unseen.any()
    assert ((seen > 0) & (seen < 4)).any()
    for name in image.outputs:
        assert (frame[name][unseen] == 0).all(), name
    assert all(difference.agrees for difference in against_reference(renderer, image))


def test_a_splat_next_to_the_camera_that_is_viewed_edge_on_leaves_its_dot(renderer):
    """All of its plane lies at z = 0: only the forms' z is not 0."""
    cloud = fs.SplatCloud([[1, 0.1, 0]], [[1, 0, 0, 0]], [[0.1, 0.2]], [0.9], colors=[[1, 0.5, 0.2]])
    camera = fs.Camera.fisheye(71, 67, math.radians(200))
    frame = assert_agrees(renderer, cloud, camera)
    assert frame["alpha"].max() > 0.3


def test_a_slight_distortion_is_nearly_a_pinhole(renderer):
    cloud = random_splats(200, 1, depth=(0.5, 6.0), scale=(0.02, 0.3))
    plain, bent = camera_with_lens(None), camera_with_lens(BrownConrady(k1=1e-7))
    assert bent.lens is not None
    a, b = (renderer.render(cloud, camera, ALL_OUTPUTS) for camera in (plain, bent))
    for name in ("rgb", "normal"):
        assert np.quantile(np.abs(a[name] - b[name]), 0.999) < 1e-3
    assert np.quantile(np.abs(a["depth"] - b["depth"]), 0.999) < 1e-2


def test_depths_of_a_fisheye_are_distances(renderer):
    """A wall at z = 2: the distance grows as 1 / cos; along z with parallel rays it is 2."""
    wall = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[50, 50]], [1.0], colors=[[1, 1, 1]])
    fisheye = fs.Camera.fisheye(101, 101, math.radians(120))
    depth = renderer.render(wall, fisheye, ALL_OUTPUTS)["depth"]
    angles = np.radians((np.arange(101) + 0.5 - 50.5) * 120 / 101)
    np.testing.assert_allclose(depth[50], 2 / np.cos(angles), rtol=1e-5)
    parallel = fs.Camera.orthographic(64, 48, 4.0)
    np.testing.assert_allclose(renderer.render(wall, parallel, ALL_OUTPUTS)["depth"], 2, rtol=1e-5)


@pytest.mark.parametrize("name", ["fisheye", "parallel"])
def test_bands_are_bit_identical(renderer, name):
    cloud, camera = random_splats(300, 2, depth=(-4.0, 5.0)), CAMERAS[name]
    first = renderer.render(cloud, camera, ALL_OUTPUTS)["rgb"]
    assert (renderer.render(cloud, camera, ALL_OUTPUTS)["rgb"] == first).all()
    backend = renderer.backend
    held = backend.pair_budget
    backend.pair_budget = 50
    try:
        assert (renderer.render(cloud, camera, ALL_OUTPUTS)["rgb"] == first).all()
    finally:
        backend.pair_budget = held


@pytest.mark.parametrize("name", ["distortion", "fisheye", "panorama", "parallel"])
def test_lenses_in_single_precision(renderer, name):
    """The projection of devices without float64, held as the pinhole's is: to a tenth of an 8-bit step."""
    cloud = random_splats(200, 0, depth=(0.5, 6.0))
    frame = renderer.render(cloud, CAMERAS[name], quality="fast")
    expected = reference_pixels(cloud, CAMERAS[name], ("rgb",), "fast")
    excess = np.abs(frame["rgb"] - expected["rgb"]).max(2) - expected["error_bound"]
    assert np.quantile(excess, 0.999) < 0.1 / 255
    assert excess.max() < 2.0 / 255
