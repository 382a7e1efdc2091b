"""Box footprints: their coverage, no seams between them, and every device against the reference."""

import math
from dataclasses import replace

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, assert_agrees, random_splats
from sampling import SAMPLES, alternate

import fidsplat as fs
from fidsplat.selftest.clouds import quaternion, splats
from fidsplat.splats.rotations import quaternion_to_matrix

CAMERA = fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
SMALL = fs.Camera.look_at(81, 59, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
EXACT = fs.Quality(lowpass="none")
SEAM = 1e-4
"""of a box 1000 px wide: float32 rounds its edges' distances (up to 1000 px) to 6e-5 px each"""


def overlap(edges, pixels):
    """How much (pixels, cells) of each pixel [k, k + 1) the cells between edges (cells + 1,) cover."""
    left, right = np.arange(pixels)[:, None], np.arange(pixels)[:, None] + 1
    return np.maximum(np.minimum(right, edges[1:]) - np.maximum(left, edges[:-1]), 0)


def area_sampled(marker, px_per_module, center, size, background):
    """The printed marker from the front: every pixel is the exact mean of the texture over its area."""
    h, w = marker.grid.shape
    across = overlap(center[0] + (np.arange(w + 1) - w / 2) * px_per_module, size[0])
    down = overlap(center[1] + (np.arange(h + 1) - h / 2) * px_per_module, size[1])
    light = down @ (1.0 - marker.grid) @ across.T
    return light + background * (1 - down.sum(1)[:, None] * across.sum(1))


@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("px_per_module", [0.37, 2.5, 4.571])
def test_an_exact_marker_is_its_area_sampled_texture(renderer, px_per_module, samples):
    """QR version 22, frontal: no worse than 80 dB (rounding alone), where `fitted` has 26."""
    marker = fs.marker("qr-v22-L:" + "fidsplat" * 100, mixture="exact")
    focal = 4 * px_per_module / marker.module
    size = (
        math.ceil(px_per_module * marker.grid.shape[1]) + 40,
        math.ceil(px_per_module * len(marker.grid)) + 30,
    )
    center = (size[0] / 2 + 1.3, size[1] / 2 - 0.2)
    pose = np.eye(4)
    pose[2, 3] = 4
    camera = fs.Camera.pinhole(*size, focal, focal, *center, pose)
    background = 0.3
    quality = EXACT.with_(samples=samples)
    frame = renderer.render(marker.cloud, camera, ALL_OUTPUTS, quality, background=(background,) * 3)
    ideal = area_sampled(marker, px_per_module, center, size, background)
    error = np.abs(frame["rgb"] - ideal[..., None])
    psnr = -10 * math.log10(float((error**2).mean()))
    print(f"{px_per_module} px per module, {samples} x {samples}: {psnr:.1f} dB, {error.max():.1e}")
    assert psnr > 80
    assert error.max() < 1e-3


def poses():
    """Tilts, spins, distances and sub-pixel shifts: modules from far below a pixel to hundreds of pixels."""
    generator = np.random.default_rng(3)
    for tilt in (0, 25, 60, 80):
        for distance in (0.05, 0.4, 3.0, 40.0):
            spin, shift = generator.uniform(0, 90), generator.uniform(-0.5, 0.5, 2)
            yield tilt, spin, distance, shift


@pytest.mark.parametrize(("tilt", "spin", "distance", "shift"), list(poses()))
def test_boxes_of_a_sheet_add_up_to_it(renderer, tilt, spin, distance, shift):
    """A sheet cut into rectangles at random covers what one box of its size covers, in every pixel, and a
    white sheet is as white: no seam at any tilt, distance and shift. Its depth is the plane's, as that of the
    one box is, also where boxes end within a pixel.
    """
    generator = np.random.default_rng(7)
    bits = generator.integers(0, 2, (9, 9))
    rectangles = cut(bits.shape, generator)
    corners = np.array(rectangles, float)
    half = (corners[:, 2:] - corners[:, :2]) / 2
    middle = (corners[:, :2] + corners[:, 2:]) / 2 - 4.5
    sheet = boxes_of(middle / 9, half / 9)
    full_sheet = boxes_of(np.zeros((1, 2)), np.full((1, 2), 0.5))
    a, b = math.radians(tilt), math.radians(spin)
    target = (0.11, 0.07, 0.0)
    position = np.add(
        target, distance * np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), -math.cos(a)])
    )
    looking = fs.Camera.look_at(123, 97, 0.9, position, target)
    camera = fs.Camera.pinhole(
        123, 97, looking.fx, looking.fy, looking.cx + shift[0], looking.cy + shift[1], looking.world_to_camera
    )
    quality = EXACT.with_(transmittance_stop=0.0)
    parts, one = (renderer.render(cloud, camera, ALL_OUTPUTS, quality) for cloud in (sheet, full_sheet))
    assert one["alpha"].max() > 0.0
    assert np.abs(parts["alpha"] - one["alpha"]).max() < SEAM
    assert np.abs(parts["rgb"] - parts["alpha"][..., None]).max() < SEAM
    inside = one["alpha"] > 0.999
    assert np.allclose(parts["depth"][inside], one["depth"][inside], rtol=1e-5, atol=0)


def test_depth_over_boxes_that_are_a_small_part_of_a_pixel_is_their_planes(renderer):
    """As over the modules of a large code from afar, steeply aside: 0.3 x 0.06 pixels."""
    middle = (np.indices((96, 96)).reshape(2, -1).T - 47.5) / 96
    sheet = boxes_of(middle, np.full((96 * 96, 2), 0.5 / 96))
    full_sheet = boxes_of(np.zeros((1, 2)), np.full((1, 2), 0.5))
    tilt, quality = math.radians(80), EXACT.with_(transmittance_stop=0.0)
    camera = fs.Camera.look_at(123, 97, 0.9, (0, -4 * math.sin(tilt), -4 * math.cos(tilt)), (0, 0, 0))
    parts, one = (renderer.render(cloud, camera, ALL_OUTPUTS, quality) for cloud in (sheet, full_sheet))
    inside = one["alpha"] > 0.999
    assert inside.sum() > 50
    assert np.allclose(parts["depth"][inside], one["depth"][inside], rtol=1e-6, atol=0)


def test_boxes_of_one_plane_that_overlap_are_no_more_than_opaque(renderer):
    """The areas add up, at most to the complete pixel."""
    twice = boxes_of(np.zeros((2, 2)), np.full((2, 2), 0.5))
    camera = fs.Camera.look_at(123, 97, 0.9, (0, 0, -3), (0, 0, 0))
    frame = renderer.render(twice, camera, ALL_OUTPUTS, EXACT.with_(transmittance_stop=0.0))
    assert frame["alpha"].max() == frame["rgb"].max() == 1
    assert frame["alpha"].min() == 0


def cut(shape, generator):
    """A partition (x0, y0, x1, y1) of a grid with T-junctions: halves at random, down to single cells."""
    todo, done = [(0, 0, shape[1], shape[0])], []
    while todo:
        x0, y0, x1, y1 = todo.pop()
        if (x1 - x0 <= 1 and y1 - y0 <= 1) or generator.random() < 0.1:
            done.append((x0, y0, x1, y1))
        elif x1 - x0 > y1 - y0 or (x1 - x0 == y1 - y0 and generator.random() < 0.5):
            at = int(generator.integers(x0 + 1, x1))
            todo += [(x0, y0, at, y1), (at, y0, x1, y1)]
        else:
            at = int(generator.integers(y0 + 1, y1))
            todo += [(x0, y0, x1, at), (x0, at, x1, y1)]
    return done


def boxes_of(middle, half):
    n = len(middle)
    means = np.column_stack([middle, np.zeros(n)])
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return (
        fs.SplatCloud(means, quats, half, np.ones(n), colors=np.ones((n, 3)))
        .with_boxes()
        .with_coplanar_groups(0)
    )


def test_light_is_conserved(renderer):
    """The opacities that a small tilted box adds to an image sum up to its projected area."""
    rotation = [math.cos(0.35), math.sin(0.35), 0.2, 0.1]
    cloud = fs.SplatCloud([(0, 0, 4)], [rotation], [(0.02, 0.07)], [1.0], colors=[(1, 1, 1)]).with_boxes()
    areas = []
    generator = np.random.default_rng(0)
    for _ in range(20):
        cx, cy = 20 + generator.uniform(0, 1, 2)
        camera = fs.Camera.pinhole(40, 40, 100.0, 100.0, cx, cy)
        areas.append(float(renderer.render(cloud, camera, ALL_OUTPUTS, EXACT)["alpha"].sum()))
    corners = fs.Camera.pinhole(40, 40, 100.0, 100.0, 20, 20).project(corners_of(cloud))
    x, y = corners.T
    area = abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
    assert np.mean(areas) == pytest.approx(area, rel=0.02)


def corners_of(cloud):
    axes = quaternion_to_matrix(cloud.quats)[0, :, :2] * cloud.scales[0]
    return cloud.means[0] + np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ axes.T


@pytest.mark.parametrize(("seed", "quality"), list(enumerate(("standard", "reference", "gsplat"))))
def test_boxes_around_and_behind_the_camera(renderer, seed, quality):
    """Bounds lose nothing: every device agrees with the reference, which asks every pixel."""
    assert_agrees(renderer, random_splats(60, seed=seed).with_boxes(), SMALL, quality=quality)


def test_a_sharp_corner_outside_the_image_reaches_into_it(renderer):
    """A box beside a disk, almost edge-on and 42 pixels left of the image: between edges that meet at so
    sharp an angle lies a little of every sample far beyond the corner, in the image's first columns too."""
    along = np.array([-37, 0, 30]) / math.hypot(37, 30)  # of the ray to its middle
    across = np.array([30, 0, 37]) / math.hypot(37, 30)
    away = math.cos(0.016) * along + np.array([0, math.sin(0.016), 0])
    means = np.array([(-37 / 30, 0.0, 1.0), (0.0, 0.2, 2.0)])
    cloud = splats(means, quaternion(across + away, away - across), 0.05, 1.0)
    cloud = cloud.with_boxes(np.array([True, False]))
    camera = fs.Camera.pinhole(64, 48, 60.0, 60.0, 32.0, 24.5, np.eye(4))
    frame = assert_agrees(renderer, cloud, camera, quality=fs.Quality(alpha_cutoff=1 / 255))
    assert frame["alpha"][24, 0] > 5e-3


def test_boxes_end_at_the_near_plane(renderer):
    cloud = random_splats(80, seed=2, depth=(-1.0, 4.0), scale=(0.1, 1.0), across=1.0).with_boxes()
    near = replace(SMALL, near=1.5)
    frame = assert_agrees(renderer, cloud, near)
    full_frame = renderer.render(cloud, SMALL, ALL_OUTPUTS)
    assert np.abs(frame["rgb"] - full_frame["rgb"]).max() > 0.1


@pytest.mark.parametrize(("lowpass", "samples"), alternate({"none": "none", "screen": "screen"}, SAMPLES))
def test_a_scene_of_both_footprints(renderer, lowpass, samples):
    cloud = random_splats(150, seed=4, depth=(-0.5, 6.0))
    mixed = cloud.with_boxes(np.arange(150) % 3 == 0)
    assert mixed.footprint == "mixed"
    quality = fs.Quality(lowpass=lowpass, samples=samples)
    assert_agrees(renderer, mixed, SMALL, (*ALL_OUTPUTS, "blended"), quality)


def test_the_footprint_is_a_choice_of_each_splat(renderer):
    """Boxes do not change the bits of Gaussians, nor Gaussians those of boxes."""
    cloud = random_splats(40, seed=9, depth=(1.0, 4.0))
    behind = random_splats(1, seed=2, depth=(50.0, 51.0))
    for kind in (False, True):
        alone = renderer.render(cloud.with_boxes(kind), CAMERA, ALL_OUTPUTS, EXACT)["rgb"]
        culled = fs.SplatCloud.concatenate([cloud.with_boxes(kind), hidden(behind).with_boxes(not kind)])
        assert culled.footprint == "mixed"
        assert np.array_equal(renderer.render(culled, CAMERA, ALL_OUTPUTS, EXACT)["rgb"], alone)


def hidden(cloud):
    return fs.SplatCloud(-cloud.means, cloud.quats, cloud.scales * 0.01, cloud.opacities, colors=cloud.colors)


@pytest.mark.parametrize("tilt", [0, 35, 70])
def test_markers_of_boxes_between_splats(renderer, tilt):
    """Layers of boxes and of Gaussians and splats of no plane, all outputs."""
    angle = math.radians(tilt)
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    pose[:3, 3] = (0.1, 0, 2)
    tag = fs.marker("apriltag:36h11:5", size=0.8, mixture="exact").cloud.transformed(pose)
    pose[:3, 3] = (-0.3, 0.1, 2.4)
    other = fs.marker("aruco:4x4_50:7", size=0.7, mixture="fitted").cloud.transformed(pose)
    around = random_splats(40, seed=3, depth=(1.2, 3.5), scale=(0.02, 0.2), across=0.8)
    scene = fs.SplatCloud.concatenate([tag.with_labels(1), other.with_labels(2), around])
    assert_agrees(renderer, scene, SMALL)
    assert_agrees(renderer, tag, SMALL, quality=EXACT)
