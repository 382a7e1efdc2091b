"""Cases of group C: depth order, ties and sort keys."""

import math

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, against_reference, assert_agrees, random_splats

import fidsplat as fs
from fidsplat.cameras import Camera
from fidsplat.scenes.random_clouds import load_scene, standard_camera
from fidsplat.selftest import clouds, order
from fidsplat.selftest.agreement import FrameSpec, differing, render, render_intermediates
from fidsplat.selftest.clouds import splats, subset_of
from fidsplat.selftest.order import (
    SMOOTH,
    WALL_STEP,
    camera_path,
    composited_parts,
    faint_between,
    largest_jump,
    tag,
    tag_and_large_splat,
)


@pytest.mark.parametrize("away", [0.0, 1.0])
def test_fronto_parallel_splats_do_tie(renderer, away):
    """Case C1 requires ties: rounding leaves few distinct depths of 200 splats."""
    keys = render_intermediates(renderer, order.fronto_parallel(away))["keys"]
    assert len(np.unique(keys)) < 50


def test_a_tag_jumps_only_in_centre_order(renderer):
    """Fronto-parallel, half of the depths change order within one step of 1e-4 degrees."""
    cloud = tag()
    before = largest_jump(renderer, camera_path(cloud, "centre", steps=2))[0]
    after = largest_jump(renderer, camera_path(cloud, "auto", steps=2))[0]
    assert before > 0.2
    assert after < 1e-4


def test_a_tag_in_front_of_a_wall_does_not_jump(renderer):
    """With ten times the step, only edges move."""
    cloud = order.tag_before_wall(2000)
    for tilt in (0.0, 30.0, 60.0):
        before, after = (
            largest_jump(renderer, camera_path(cloud, order, 2, tilt, 54, 45, WALL_STEP))[0]
            for order in ("centre", "pixel")
        )
        assert before > 0.15
        assert after < 10 * SMOOTH


@pytest.mark.parametrize("cloud", [order.crossing(30), order.fan()], ids=["crossing", "fan"])
def test_intersecting_splats_equal_their_composited_images(renderer, cloud):
    """Images of single splats, composited by depth at each pixel, equal the image of all."""
    view = Camera.pinhole(40, 30, 40.0, 40.0, 20.0, 15.0)
    single = [subset_of(cloud, np.array([k])) for k in range(len(cloud))]
    got, expected = composited_parts(renderer, single, view, "pixel")
    assert np.abs(got - expected).max() < 1e-5
    center = composited_parts(renderer, single, view, "centre")[0]
    assert np.abs(center - expected).max() > 0.1


@pytest.mark.parametrize(
    "cloud",
    # the last has more splats in a tile than a chunk
    [order.crossing(), order.fan(), order.crossing(200)],
    ids=["crossing", "fan", "many"],
)
def test_images_do_not_depend_on_the_size_of_the_k_buffer(renderer, cloud):
    """A k-buffer of one or few fragments needs several passes and is bit-identical."""
    spec = FrameSpec(cloud, clouds.camera(50, 40, 40.0), fs.Quality(order="pixel"), ALL_OUTPUTS)
    shapes = renderer.backend.configs("k_buffer")
    expected = render_intermediates(renderer, spec)
    for name, shape in shapes.items():
        assert differing(render_intermediates(renderer, spec, shape), expected, spec.outputs) == 0, name


def _faint(count, seed, depth, scale, opacity=0.3, across=2.0):
    """Random translucent splats, so that complete lists are composited."""
    generator = np.random.default_rng(seed)
    means = np.column_stack(
        [generator.uniform(-across, across, (count, 2)), generator.uniform(*depth, count)]
    )
    scales = np.exp(generator.uniform(*np.log(scale), (count, 2)))
    return splats(means, generator.normal(size=(count, 4)), scales, opacity, generator.random((count, 3)))


def _near_elsewhere() -> dict[str, fs.SplatCloud]:
    """Large splats whose nearest points are in other tiles than most of their fragments."""
    generator = np.random.default_rng(4)
    nearly_edge_on = [
        clouds.rotation((1, 0, 0) if flat else (0, 1, 0), angle)
        for flat, angle in zip(generator.random(300) < 0.5, 90 + generator.uniform(-12, 12, 300), strict=True)
    ]
    edge_on = _faint(300, 5, (2, 3), (2.0, 3.0), across=0.3)
    edge_on = splats(edge_on.means, nearly_edge_on, edge_on.scales, 0.3, edge_on.colors)
    planes = np.where(generator.random(400) < 0.5, generator.integers(0, 40, 400), -1)
    printed = _faint(160, 6, (2.2, 2.2001), (0.02, 0.1), across=0.1).with_coplanar_groups(0)
    return {
        "crossing": _faint(400, 3, (0.5, 4.0), (0.2, 0.8)),
        "behind a fisheye": _faint(300, 3, (0.5, 4.0), (0.2, 0.8)),
        "boxes": _faint(300, 12, (1.0, 4.0), (0.1, 0.4)).with_boxes(),
        # more than can be deferred
        "thousands": _faint(2600, 8, (1.0, 4.0), (1.0, 3.0), 0.01),
        "edge-on": edge_on,
        "through the camera": _faint(300, 9, (-0.5, 1.5), (0.5, 4.0), 0.05),
        "huge": _faint(300, 10, (1.0, 30.0), (50.0, 1000.0), 0.05),
        # layers are nearer than the depths of their splats in lookahead
        "bent sheets": _faint(400, 13, (1.0, 3.0), (0.2, 0.8)).with_coplanar_groups(planes),
        "through a sheet": fs.SplatCloud.concatenate(
            [_faint(100, 7, (1.5, 4.0), (0.3, 1.5), 0.1), printed, _faint(200, 11, (2.5, 4.0), (0.3, 1.5))]
        ),
    }


NEAR_ELSEWHERE = _near_elsewhere()


@pytest.mark.parametrize("name", NEAR_ELSEWHERE)
def test_deferral_and_lookahead_are_bit_identical(renderer, name):
    """Deferred splats and lookahead (CPUs) are bit-identical with bounds by the nearest depths of splats."""
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("Warp's schedules have no deferral")
    views = {
        "thousands": clouds.camera(5, 4, 4.0),  # all are composited; groups have k-buffers of eight
        "behind a fisheye": Camera.fisheye(34, 20, math.radians(100)),
    }
    view = views.get(name, clouds.camera(34, 20, 30.0))
    spec = FrameSpec(NEAR_ELSEWHERE[name], view, fs.Quality(order="pixel"), ("rgb", "depth", "normal"))
    groups = renderer.backend.configs("schedule")["groups"]
    assert (
        differing(
            render_intermediates(renderer, spec, groups), render_intermediates(renderer, spec), spec.outputs
        )
        == 0
    )


def test_of_equal_depths_in_the_k_buffer_the_first_is_in_front(renderer):
    """One column of pixels has two splats of equal depth in front of a wall; the next column has only the
    second one, in front of the fragment that was inserted first."""
    column = 4 / 50  # of a pixel, at the depth of the wall
    cloud = fs.SplatCloud(
        # a wall with the smallest nearest depth; a line across the next column that leans forward
        [(0, 0, 4), (column, 0, 3.9), (0, 0, 3), (0, 0, 3)],
        [(math.cos(0.4), 0, math.sin(0.4), 0), (math.cos(0.6), math.sin(0.6), 0, 0), *[(1, 0, 0, 0)] * 2],
        [(9, 9), (0.01, 1), (0.01, 1), (1, 1)],
        [0.9, 0.9, 0.9, 0.9],
        colors=[(0, 0, 1), (0, 0, 1), (1, 0, 0), (0, 1, 0)],
    )
    camera = Camera.pinhole(5, 5, 50.0, 50.0, 2.5, 2.5)
    quality = fs.Quality(order="pixel", lowpass="none")
    rgb = renderer.render(cloud, camera, quality=quality)["rgb"]
    assert rgb[2, 2] == pytest.approx([0.9, 0.09, 0.009], abs=2e-3)
    assert rgb[2, 3] == pytest.approx([0, 0.9, 0.09], abs=2e-2)


@pytest.mark.exhaustive
def test_every_pixel_of_a_hundred_thousand_splats(renderer):
    """Against a float64 sort of each pixel."""
    cloud, _ = load_scene("r100k_720p")
    camera, quality = standard_camera(320, 180), fs.Quality(order="pixel")
    differences = against_reference(renderer, FrameSpec(cloud, camera, quality, ("rgb", "depth")))
    print(renderer.device.name, *differences, sep="\n")
    assert all(difference.agrees for difference in differences)


def test_a_faint_splat_inside_of_a_group_changes_little(renderer):
    """A splat at the alpha cut-off of 1/255; a layer that it divided would change by 0.26."""
    with_it, without = (render(renderer, faint_between(n / 255))["rgb"] for n in (1.01, 0.99))
    assert 0 < np.abs(with_it - without).max() < 1.01 / 255


@pytest.mark.parametrize("side", order.SIDES)
def test_a_layer_is_composited_at_its_depth(renderer, side):
    """The centre of the large splat is on the other side."""
    got, expected = composited_parts(renderer, tag_and_large_splat(side), order.ON_TAGS)
    assert expected.max() > 0.5
    assert np.abs(got - expected).max() < 1e-6


def test_a_cutoff_does_not_move_a_layer(renderer):
    """Faint tails of a tilted group in front of a splat 2 mm behind it: clamped to the range above 1/255
    they would move the layer back by 6 mm."""
    tilted, along = (math.cos(math.pi / 6), 0, math.sin(math.pi / 6), 0), np.array([0.5, 0, -(0.75**0.5)])
    spot = splats([(0, 0, 2)], tilted, 0.05, 0.5, (1, 0, 0))
    tails = splats([np.array([0, 0, 2]) - 4 * along] * 20, tilted, 1.0, 1.0, (1, 0, 0))
    sheet = fs.SplatCloud.concatenate([spot, tails]).with_coplanar_groups(0)
    cloud = fs.SplatCloud.concatenate([sheet, splats([(0, 0, 2.002)], tilted, 0.05, 0.9, (0, 1, 0))])
    view = Camera.pinhole(5, 5, 100.0, 100.0, 2.5, 2.5)
    few, all_of_them = (
        renderer.render(cloud, view, quality=fs.Quality(alpha_cutoff=cutoff))["rgb"][2, 2]
        for cutoff in (1 / 255, 1e-5)
    )
    assert few[0] > 0.45
    assert np.abs(few - all_of_them).max() < 0.02


def test_several_layers_in_the_k_buffer(renderer):
    """Three groups one behind the other, and a large splat between them with the nearest centre."""
    colors = np.eye(3)
    sheets = [
        splats([(0, 0, z)], (1, 0, 0, 0), 0.5, 0.6, colors[k]).with_coplanar_groups(0)
        for k, z in enumerate((2, 4, 6))
    ]
    view = Camera.pinhole(17, 17, 20.0, 20.0, 8.5, 8.5)
    got, expected = composited_parts(renderer, [*sheets, splats([(0, 0, 5)], (1, 0, 0, 0), 2.0, 0.5)], view)
    assert np.abs(got - expected).max() < 1e-6


@pytest.mark.parametrize("seed", [1, 2])
def test_intersecting_coplanar_groups(renderer, seed):
    """More layers at a pixel than the k-buffer holds; a completed layer may be in front of others."""
    cloud = random_splats(24, seed, depth=(0.8, 4.0), scale=(0.05, 0.5), across=1.2)
    cloud = cloud.with_coplanar_groups(np.arange(24) // 4 - 1)
    assert_agrees(renderer, cloud, Camera.pinhole(37, 22, 30.0, 30.0, 18.0, 11.0), ("rgb", "depth"))


def test_a_real_marker_does_not_jump(renderer):
    cloud = fs.marker("apriltag:36h11:5", size=1.0, mixture="fitted").cloud
    for tilt in (0.0, 40.0):
        assert largest_jump(renderer, camera_path(cloud, "auto", steps=3, tilt=tilt))[0] < SMOOTH
    assert largest_jump(renderer, camera_path(cloud, "centre", steps=3))[0] > 0.2


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_a_marker_changes_no_pixel_that_it_does_not_cover(renderer, lens):
    """By `auto` the other splats are bit-identical to those by centre without the marker."""
    others, sheet = (
        random_splats(150, 14, depth=(0.8, 4.0), scale=(0.1, 0.6)),
        tag().transformed(order._tag_pose()),
    )
    view = clouds.camera(60, 45, 48.0) if lens == "pinhole" else Camera.fisheye(60, 45, 2.0)
    both = fs.SplatCloud.concatenate([others, sheet])
    together, alone, marker = (
        renderer.render(cloud, view, ALL_OUTPUTS, background=(0.1, 0.2, 0.3))
        for cloud in (both, others, sheet)
    )
    outside = marker["alpha"] == 0
    assert 0.1 < outside.mean() < 0.95
    for name in ("rgb", *ALL_OUTPUTS):
        assert np.array_equal(together[name][outside], alone[name][outside]), name
    assert np.abs(together["rgb"] - alone["rgb"])[~outside].max() > 0.1
