"""Boxes through lenses: no seam in a sheet of them, bounds that lose nothing, the area of their image."""

import math
from dataclasses import replace

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, assert_agrees, random_splats, reference_pixels
from sampling import SAMPLES, alternate
from test_boxes import EXACT, boxes_of, cut
from test_lens_frames import CAMERAS, each_camera

import fidsplat as fs
from fidsplat.cameras.raster import raster_of
from fidsplat.splats.rotations import quaternion_to_matrix

SEAM = 1e-3


@each_camera
@pytest.mark.parametrize("seed", [0, 1])
def test_boxes_all_around_the_camera(renderer, camera, seed):
    """Bounds lose nothing: the reference asks every sample."""
    assert_agrees(renderer, random_splats(80, seed, depth=(-5.0, 6.0)).with_boxes(), camera, quality=EXACT)


@each_camera
def test_small_boxes_of_all_shapes(renderer, camera):
    cloud = random_splats(200, 4, depth=(-4.0, 4.0), scale=(1e-4, 0.2), across=4.0)
    assert_agrees(renderer, cloud.with_boxes(), camera, quality=EXACT)


@each_camera
def test_boxes_end_at_the_near_plane_and_the_far(renderer, camera):
    """Fragments are culled at the near plane, complete boxes at the far plane; one side may be much
    longer."""
    cloud = random_splats(80, 2, depth=(-3.0, 5.0), scale=(0.02, 1.0), across=1.5).with_boxes()
    cut_off = replace(camera, near=1.0, far=3.0)
    frame = assert_agrees(renderer, cloud, cut_off, quality=EXACT)
    full_frame = renderer.render(cloud, camera, ALL_OUTPUTS, EXACT)
    assert np.abs(frame["rgb"] - full_frame["rgb"]).max() > 0.1


@each_camera
@pytest.mark.parametrize("narrow", [0, 1])
def test_narrow_boxes(renderer, camera, narrow):
    """Lines far thinner than a pixel: samples next to them see them, whichever side is the short one."""
    cloud = random_splats(60, 4, depth=(-2.0, 3.0), scale=(0.05, 0.3), across=2.0)
    scales = cloud.scales.copy()
    scales[:, narrow] = 1e-5
    lines = fs.SplatCloud(cloud.means, cloud.quats, scales, cloud.opacities, colors=cloud.colors)
    assert_agrees(renderer, lines.with_boxes(), camera, quality=EXACT)


@each_camera
def test_boxes_much_larger_than_the_image(renderer, camera):
    cloud = random_splats(40, 5, depth=(-4.0, 4.0), scale=(0.1, 30.0))
    assert_agrees(renderer, cloud.with_boxes(), camera, quality=EXACT)


# those that test_layers of test_lens_frames.py leaves out, each on another device
@pytest.mark.parametrize(("camera", "samples"), alternate(CAMERAS, dict(reversed(SAMPLES.items()))))
def test_boxes_and_gaussians_in_layers(renderer, camera, samples):
    pose = np.eye(4)
    pose[:3, 3] = (0.1, 0, 2)
    tag = fs.marker("apriltag:36h11:5", size=0.8, mixture="exact").cloud.transformed(pose)
    around = random_splats(80, seed=3, depth=(-2.0, 3.5), scale=(0.02, 0.2))
    mixed = fs.SplatCloud.concatenate([tag, around.with_boxes(np.arange(80) % 3 == 0)])
    assert_agrees(renderer, mixed, camera, quality=fs.Quality(samples=samples))


LARGE = {
    "distortion": fs.Camera.pinhole(480, 360, 400.0, 400.0, 240.0, 180.0, lens=fs.BrownConrady(-0.2, 0.05)),
    "fisheye": fs.Camera.fisheye(480, 360, math.radians(150)),
    "panorama": fs.Camera.equirectangular(480, 240),
}


@pytest.mark.parametrize("camera", LARGE.values(), ids=LARGE)
def test_a_small_box_is_listed_for_few_tiles(renderer, camera):
    """No more than 1.2 times those of a Gaussian cut off at 3.3 standard deviations (1/255), while it is not
    viewed edge-on."""
    cloud = random_splats(300, 2, depth=(0.8, 4.0), scale=(0.01, 0.04), across=0.8)
    turns = np.random.default_rng(1).uniform(-0.15, 0.15, (300, 4)) + np.array([1, 0, 0, 0])
    cloud = fs.SplatCloud(cloud.means, turns, cloud.scales, np.ones(300), colors=cloud.colors)
    boxes = renderer.render(cloud.with_boxes(), camera, ALL_OUTPUTS, EXACT)
    disks = renderer.render(cloud, camera, ALL_OUTPUTS, EXACT.with_(alpha_cutoff=1 / 255))
    assert boxes.stats["visible"] > 50
    assert boxes.stats["pairs"] < 1.2 * disks.stats["pairs"]


def camera_from(camera, tilt, distance, spin=20.0):
    """The camera before the middle of a sheet 1 m wide at z = 0, off its axis."""
    a, b = math.radians(tilt), math.radians(spin)
    target = np.array((0.11, 0.07, 0.0))
    away = np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), -math.cos(a)])
    pose = fs.Camera.look_at(64, 48, 1.0, target + distance * away, target + 0.1 * distance * np.eye(3)[0])
    return camera.with_pose(pose.world_to_camera)


def widened(camera):
    """Samples (h, w) that see ten times as wide as others do: the last ones before the fold of a
    distortion."""
    if camera.lens.kind == "orthographic":
        return np.zeros((camera.height, camera.width), bool)
    raster = raster_of(camera.lens, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    width = np.linalg.norm(raster.ray_derivatives, axis=(2, 3))
    return width > 10 * np.nanmedian(width)


@each_camera
@pytest.mark.parametrize(
    ("tilt", "distance"), [(0, 0.1), (60, 0.1), (0, 0.7), (40, 0.7), (75, 0.7), (40, 8.0)]
)
def test_boxes_of_a_sheet_add_up_to_it(renderer, camera, tilt, distance):
    """A sheet cut at random covers what one box of its size covers in every pixel, and a white one is as
    white."""
    corners = np.array(cut((9, 9), np.random.default_rng(7)), float)
    half = (corners[:, 2:] - corners[:, :2]) / 2
    middle = (corners[:, :2] + corners[:, 2:]) / 2 - 4.5
    sheet = boxes_of(middle / 9, half / 9)
    full_sheet = boxes_of(np.zeros((1, 2)), np.full((1, 2), 0.5))
    # parallel rays would see the near plane cut the sheet
    looking = camera_from(camera, tilt, 0.7 if camera.lens.kind == "orthographic" else distance)
    quality = EXACT.with_(transmittance_stop=0.0)
    parts, one = (renderer.render(cloud, looking, ALL_OUTPUTS, quality) for cloud in (sheet, full_sheet))
    assert one["alpha"].max() > 0.3
    even = ~widened(looking)
    assert even.mean() > 0.9
    assert np.abs(parts["alpha"] - one["alpha"])[even].max() < SEAM
    assert np.abs(parts["rgb"] - parts["alpha"][..., None])[even].max() < SEAM


@each_camera
@pytest.mark.parametrize(("size", "shifts"), [(0.004, 8), (0.2, 3)])
def test_light_is_that_of_the_image(renderer, camera, size, shifts):
    """The opacities that a tilted box adds to an image sum up to the area of its image, below a pixel and
    above it, on average over shifts x shifts positions in a pixel."""
    quaternion = [math.cos(0.35), math.sin(0.35), 0.2, 0.1]
    box = fs.SplatCloud(
        [(0.1, 0.1, 0.1)], [quaternion], [(size, 1.5 * size)], [1.0], colors=[(1, 1, 1)]
    ).with_boxes()
    looking = camera_from(camera, 10, 2.0)
    edge = np.linspace(-1, 1, 50)
    around = [(edge, -1 + 0 * edge), (1 + 0 * edge, edge), (-edge, 1 + 0 * edge), (-1 + 0 * edge, -edge)]
    outline = np.concatenate([np.stack(side, 1)[:-1] for side in around]) * (size, 1.5 * size)
    x, y = looking.project(box.means[0] + outline @ quaternion_to_matrix(box.quats)[0, :, :2].T).T
    area = abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
    areas = []
    grid = np.stack(np.meshgrid(np.arange(shifts), np.arange(shifts)), 2).reshape(-1, 2)
    for shift in (grid + np.random.default_rng(0).uniform(0, 1, (shifts**2, 2))) / shifts:
        moved = replace(looking, cx=looking.cx + shift[0], cy=looking.cy + shift[1])
        areas.append(float(renderer.render(box, moved, ALL_OUTPUTS, EXACT)["alpha"].sum()))
    assert np.mean(areas) == pytest.approx(area, rel=0.03)


@pytest.mark.parametrize("name", ["distortion", "fisheye", "panorama"])
def test_boxes_through_lenses_in_single_precision(renderer, name):
    """The projection of devices without float64, held as Gaussians are: to a tenth of an 8-bit step."""
    cloud = random_splats(100, 0, depth=(0.5, 6.0)).with_boxes()
    frame = renderer.render(cloud, CAMERAS[name], ALL_OUTPUTS, "fast")
    expected = reference_pixels(cloud, CAMERAS[name], ("rgb",), "fast")
    excess = np.abs(frame["rgb"] - expected["rgb"]).max(2) - expected["error_bound"]
    assert np.quantile(excess, 0.995) < 0.1 / 255
