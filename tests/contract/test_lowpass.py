"""Low-pass filters: every device against the reference, and the properties of `pixel`."""

import math

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, assert_agrees, random_splats
from test_lens_frames import CAMERAS, EVERY_TERM

import fidsplat as fs
from fidsplat.splats.rotations import matrix_to_quaternion, quaternion_to_matrix, rigid_matrix

CAMERA = fs.Camera.look_at(81, 59, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
PIXEL = fs.Quality(lowpass="pixel")
LENSES = {
    "distortion": fs.Camera.pinhole(75, 62, 50.0, 51.0, 35.0, 32.0, lens=EVERY_TERM),
    "fisheye": fs.Camera.fisheye(70, 66, math.radians(200), coefficients=(0.02, -0.004, 0.001, -1e-4)),
    "panorama": fs.Camera.equirectangular(110, 55),
    "parallel": fs.Camera.pinhole(75, 62, 19.0, 24.0, 37.0, 31.0, lens=fs.Orthographic()),
}


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("place", ["ahead", "near", "aside"])
def test_the_screen_dot_of_splats_about_as_wide_as_it(renderer, place, samples):
    """Devices may pass over a dot that is never the larger weight, and over no other: splats of 0.5 to 4
    pixels, tilted at will, in the middle of the view, close to the near plane, at the edge of the image.
    """
    camera = fs.Camera.pinhole(61, 47, 40.0, 40.0, 30.0, 24.0)
    generator = np.random.default_rng(5)
    count = 120
    depth = generator.uniform(*{"near": (0.011, 0.05)}.get(place, (1.0, 4.0)), count)
    across = {"aside": (0.6, 0.9)}.get(place, (-0.6, 0.6))
    means = np.column_stack([generator.uniform(*across, (count, 2)), np.ones(count)]) * depth[:, None]
    widths = generator.uniform(0.5, 4.0, (count, 2)) * depth[:, None] / 40.0
    quats = generator.normal(size=(count, 4))
    colors = generator.uniform(0, 1, (count, 3))
    cloud = fs.SplatCloud(means, quats, widths, generator.uniform(0.2, 1.0, count), colors=colors)
    # one by one: none hides behind another
    for one in range(0, count, 6):
        shown = np.arange(one, one + 3)
        few = fs.SplatCloud(
            means[shown], quats[shown], widths[shown], cloud.opacities[shown], colors=colors[shown]
        )
        assert_agrees(renderer, few, camera, quality=fs.Quality(samples=samples))
    assert_agrees(renderer, cloud, camera, quality=fs.Quality(samples=samples))


def edge_on(tilt, size=1.0):
    """A splat 2 m away, long in depth and 1 mm wide, `tilt` radians from edge-on."""
    half = (math.pi / 2 - tilt) / 2
    quats = [[math.cos(half), 0.0, math.sin(half), 0.0]]
    return fs.SplatCloud([(1e-7, 0, 2)], quats, [(size, 1e-3)], [0.9], colors=[(1, 0.5, 0.2)])


@pytest.mark.parametrize("order", ["centre", "pixel"])
def test_depths_of_splats_viewed_edge_on_are_in_their_visible_part(renderer, order):
    """The low-pass shows pixels where the ray meets the plane right before the camera, or behind it."""
    camera = fs.Camera.pinhole(65, 49, 60.0, 60.0, 32.5, 24.5)
    radius = math.sqrt(2 * math.log(255))  # of the part that is 1/255 of the opacity or more
    for tilt in (0.0, 5e-9, -5e-9, 1e-5, -1e-3, 0.02, -0.2):
        for size in (0.01, 1.0):
            shown = renderer.render(edge_on(tilt, size), camera, ALL_OUTPUTS, fs.Quality(order=order))[
                "depth"
            ]
            depths = shown[shown > 0]
            assert len(depths) > 3
            reach = radius * size * math.cos(tilt)
            assert depths.min() >= max(camera.near, 2 - reach) * (1 - 1e-6)
            assert depths.max() <= (2 + reach) * (1 + 1e-6)
    # all rays meet the plane before `near` or nowhere
    shown = renderer.render(edge_on(5e-9), camera, ALL_OUTPUTS, fs.Quality(order=order))["depth"]
    assert np.allclose(shown[shown > 0], 2, rtol=1e-6)
    assert_agrees(renderer, edge_on(1e-3, 0.3), camera, quality=fs.Quality(order=order))


def test_depths_change_steadily_as_a_splat_rotates_through_edge_on(renderer):
    """A plane's horizon sweeps over the low-pass's dot; the depths there do not follow it from end to end."""
    camera, size = fs.Camera.pinhole(65, 49, 60.0, 60.0, 32.5, 24.5), 0.05
    tilts = np.linspace(-0.1, 0.1, 21)
    shown = np.stack([renderer.render(edge_on(tilt, size), camera, ALL_OUTPUTS)["depth"] for tilt in tilts])
    dot = (shown > 0).all(0)
    assert dot.sum() > 3
    ends = shown[:, dot].max() - shown[:, dot].min()
    steps = np.abs(np.diff(shown[:, dot], axis=0))
    assert ends > size
    assert steps.max() < 0.5 * ends


@pytest.mark.parametrize("order", ["centre", "pixel"])
def test_fog_does_not_depend_on_the_cut_off(renderer, order):
    """The cut-off changes a single splat by at most the cut-off, with fog and without."""
    camera, cut_off = fs.Camera.pinhole(65, 49, 60.0, 60.0, 32.5, 24.5), 1e-4
    for tilt in (5e-9, 1e-5, 1e-3, 0.02):
        wide, narrow = (
            renderer.render(edge_on(tilt), fs.Capture(camera, ("rgb", "depth"), quality, fog=fs.Fog(0.5)))[
                "rgb"
            ]
            for quality in (fs.Quality(order=order, alpha_cutoff=cut) for cut in (1e-12, cut_off))
        )
        assert np.abs(wide - narrow).max() <= cut_off + 2e-5
    assert wide.max() > 0.05


@pytest.mark.parametrize("scale", [(1e-6, 1e-2), (1e-3, 2.0), (1e-3, 50.0)])
def test_splats_of_every_size(renderer, scale):
    assert_agrees(renderer, random_splats(150, seed=7, scale=scale), CAMERA, quality=PIXEL)


@pytest.mark.parametrize("tilt", [0, 60, 89, 90])
def test_tilted_to_edge_on(renderer, tilt):
    half = math.radians(tilt) / 2
    quats = [[math.cos(half), math.sin(half), 0, 0]]
    cloud = fs.SplatCloud([(0, 0, 2)], quats, [(0.2, 0.2)], [0.95], colors=[(1, 0.5, 0.2)])
    assert_agrees(renderer, cloud, fs.Camera.pinhole(60, 60, 50.0, 50.0, 30.0, 30.0), quality=PIXEL)


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("scale", [(1e-6, 1e-2), (1e-3, 2.0)], ids=["small", "any"])
def test_splats_of_every_size_through_every_lens(renderer, camera, scale):
    cloud = random_splats(200, seed=8, depth=(-4.0, 5.0), scale=scale)
    assert_agrees(renderer, cloud, camera, quality=PIXEL)


@pytest.mark.parametrize("camera", [CAMERA, *LENSES.values()], ids=["pinhole", *LENSES])
def test_splats_that_are_viewed_nearly_edge_on(renderer, camera):
    """From a hundredth of a degree to thirty, on all sides: the depth of what a sample sees counts."""
    generator, count = np.random.default_rng(12), 250
    away = generator.normal(size=(count, 3)) * (1, 1, 0.3) + (0, 0, 1.5)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    means = away * generator.uniform(0.3, 6.0, (count, 1))
    across = np.cross(away, generator.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    tilt = np.radians(10.0 ** generator.uniform(-2, 1.5, (count, 1)))
    normals = np.cos(tilt) * across + np.sin(tilt) * away
    tangents = np.cross(normals, generator.normal(size=(count, 3)))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    turns = np.stack([tangents, np.cross(normals, tangents), normals], axis=2)
    quats = np.array([matrix_to_quaternion(quaternion) for quaternion in turns])
    colors, opacities = generator.uniform(0, 1, (count, 3)), generator.uniform(0.3, 1.0, count)
    scales = 10.0 ** generator.uniform(-3, -0.5, (count, 2))
    cloud = fs.SplatCloud(means, quats, scales, opacities, colors=colors)
    frame = assert_agrees(renderer, cloud, camera, quality=PIXEL)
    assert frame["alpha"].max() > 0.1


def test_walls_next_to_the_camera_have_no_streaks(renderer):
    """A wall that is visible from its edge, in the columns at 300 x 1.5 mm / 0.1 to 0.9 m from the middle."""
    generator, count = np.random.default_rng(5), 600
    at = generator.uniform((0.3, -1, 0.1), (0.3, 1, 0.9), (count, 3))
    quats = np.tile((math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 0.0), (count, 1))
    wall = fs.SplatCloud(
        at, quats, np.full((count, 2), 0.01), np.full(count, 0.9), colors=np.ones((count, 3))
    )
    camera = fs.Camera.pinhole(64, 48, 300.0, 300.0, 32.0, 24.0, rigid_matrix((-0.2985, 0, 0)))
    alpha = renderer.render(wall, camera, ALL_OUTPUTS, PIXEL)["alpha"]
    assert alpha[:, 32:36].max() > 0.5
    assert alpha[:, 42:].max() < 1e-3


def test_disks_far_outside_the_image_that_are_widened_into_it(renderer):
    """Their near ends, which a sample's depth brings nearer still, are in the image: one by one, since all
    that they show is their rims."""
    generator, count = np.random.default_rng(4), 120
    outward = generator.uniform((-10.0, -0.2, 0.0), (10.0, 0.2, 0.0), (count, 3))
    towards = outward + np.array([0.0, 0.0, 1.0])
    distance = generator.uniform(1.0, 3.0, (count, 1)) / np.linalg.norm(towards, axis=1, keepdims=True)
    along = towards / np.linalg.norm(towards, axis=1, keepdims=True) + 0.01 * outward
    beside = np.cross(along, np.array([0, 1, 0]) + 0.3 * generator.normal(size=(count, 3)))
    along, beside = (axis / np.linalg.norm(axis, axis=1, keepdims=True) for axis in (along, beside))
    turns = np.stack([along, beside, np.cross(along, beside)], axis=2)
    quats = np.array([matrix_to_quaternion(quaternion) for quaternion in turns])
    means = distance * towards
    scales = np.linalg.norm(means, axis=1)[:, None] * generator.uniform((0.1, 0.02), (0.16, 0.08), (count, 2))
    camera, reference = (
        fs.Camera.look_at(40, 30, math.radians(4), (0, 0, 0), (0, 0, 1)),
        fs.Renderer("reference"),
    )
    quality, shown = PIXEL.with_(alpha_cutoff=1e-8), 0
    for k in np.flatnonzero(np.abs(outward[:, 0]) > 1):
        disk = fs.SplatCloud(
            means[k : k + 1], quats[k : k + 1], scales[k : k + 1], [0.99], colors=[(1, 1, 1)]
        )
        if reference.render(disk, camera, ("alpha",), quality)["alpha"].max() > 1e-7:
            shown += 1
            assert renderer.render(disk, camera, ALL_OUTPUTS, quality)["alpha"].any()
    assert shown > 5


def test_splats_that_reach_into_a_band(renderer):
    """From above, from below and from behind the camera: a band shows them as the whole image does."""
    cloud, camera = random_splats(600, 3, depth=(-1.0, 4.0), scale=(0.01, 0.5)), CAMERA
    full_frame = renderer.render(cloud, camera, ALL_OUTPUTS, PIXEL)["rgb"]
    for band in ((0, 16), (16, 40), (40, 59)):
        rows = renderer.render_band(band, cloud, camera, ALL_OUTPUTS, PIXEL)["rgb"][slice(*band)]
        assert np.array_equal(rows, full_frame[slice(*band)]), band


def test_splats_whose_centres_lie_beyond_the_fold(renderer):
    """There is no image of theirs to be widened."""
    cloud = random_splats(150, 1, depth=(0.3, 4.0), scale=(0.02, 0.5), across=3.0)
    assert_agrees(renderer, cloud, CAMERAS["fold"], quality=PIXEL)


@pytest.mark.parametrize(("name", "mean"), [("fisheye", (0, 0, 1.5)), ("panorama", (0, -1.5, 0))])
def test_a_splat_where_the_derivative_has_no_direction(renderer, name, mean):
    """On the axis of a fisheye, at a pole of a panorama."""
    cloud = fs.SplatCloud([mean], [(0.9, 0.3, 0.2, 0.1)], [(0.02, 0.05)], [0.9], colors=[(1, 0.5, 0.2)])
    frame = assert_agrees(renderer, cloud, LENSES[name], quality=PIXEL)
    assert frame["alpha"].max() > 0.1


def test_the_screen_dot_of_walls_that_are_viewed_nearly_edge_on(renderer):
    """Their horizon passes within a pixel or two of their centre: beyond it only the dot is rendered."""
    camera = fs.Camera.pinhole(41, 31, 40.0, 40.0, 20.0, 15.0)
    generator = np.random.default_rng(3)
    for size in (0.5, 5.0, 50.0):
        for away in (0.3, 0.8, 1.5):
            half = (math.pi / 2 - away / 40.0) / 2  # of the angle by which it is tilted
            spin = generator.uniform(0, math.pi)
            quaternion = (math.cos(half), math.sin(half) * math.cos(spin), math.sin(half) * math.sin(spin), 0)
            wall = fs.SplatCloud(
                [(0.01, 0.02, 2.0)], [quaternion], [(size, size)], [0.95], colors=[(1, 0.6, 0.3)]
            )
            assert_agrees(renderer, wall, camera)


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_a_lens_keeps_the_light_of_a_splat(renderer, camera):
    """The sum of alpha over the image is 2 pi opacity times the area of the image of the one-sigma square
    of a splat far below a pixel; the area from a finite parallelogram."""
    generator = np.random.default_rng(2)
    # seen by every lens here, off its axis
    mean = np.array([0.5, -0.35, 1.5])
    cloud = fs.SplatCloud([mean], [generator.normal(size=4)], [(3e-4, 5e-4)], [0.9], colors=[(1, 1, 1)])
    axes = quaternion_to_matrix(cloud.quats)[0, :, :2] * cloud.scales[0]
    u, v = (
        (camera.project([mean + axis]) - camera.project([mean - axis]))[0] / 2
        for axis in axes.T.astype(float)
    )
    want = 2 * math.pi * 0.9 * abs(u[0] * v[1] - u[1] * v[0])
    quality = PIXEL.with_(alpha_cutoff=1e-9)
    light = float(renderer.render(cloud, camera, ALL_OUTPUTS, quality)["alpha"].sum())
    assert light == pytest.approx(want, rel=0.032)


def test_boxes_are_left_to_their_own_filter(renderer):
    mixed = random_splats(60, seed=4, depth=(0.5, 6.0)).with_boxes(np.arange(60) % 2 == 0)
    assert_agrees(renderer, mixed, CAMERA, quality=PIXEL)


@pytest.mark.parametrize("spread_px", [0.01, 0.1, 0.5, 2.0])
def test_light_does_not_depend_on_the_subpixel_position_of_a_splat(renderer, spread_px):
    """The sum of alpha over the image is the splat's own, 2 pi opacity s_u s_v, at any shift: to 3 % of
    sigma 0.5 px, and what the cut-off takes.
    """
    sums = []
    generator = np.random.default_rng(0)
    cloud = fs.SplatCloud([(0, 0, 1)], [(1, 0, 0, 0)], [(spread_px / 100,) * 2], [0.9], colors=[(1, 1, 1)])
    quality = PIXEL.with_(alpha_cutoff=1e-9)
    for _ in range(12):
        cx, cy = 20 + generator.uniform(0, 1, 2)
        camera = fs.Camera.pinhole(40, 40, 100.0, 100.0, cx, cy)
        sums.append(float(renderer.render(cloud, camera, ALL_OUTPUTS, quality)["alpha"].sum()))
    assert np.array(sums) == pytest.approx(2 * math.pi * 0.9 * spread_px**2, rel=0.032)


def test_the_screen_filter_keeps_no_light(renderer):
    """Why there is another: a splat of a hundredth of a pixel is rendered as a dot of 0.7 px, some 5000 times
    too bright."""
    cloud = fs.SplatCloud([(0, 0, 1)], [(1, 0, 0, 0)], [(1e-4, 1e-4)], [0.9], colors=[(1, 1, 1)])
    camera = fs.Camera.pinhole(40, 40, 100.0, 100.0, 20.2, 20.4)
    qualities = {name: fs.Quality(lowpass=name, alpha_cutoff=1e-9) for name in ("screen", "pixel")}
    light = {
        name: float(renderer.render(cloud, camera, ALL_OUTPUTS, quality)["alpha"].sum())
        for name, quality in qualities.items()
    }
    assert light["screen"] == pytest.approx(math.pi * 0.9, rel=0.05)
    assert light["pixel"] == pytest.approx(2 * math.pi * 0.9 * 1e-4, rel=0.05)
