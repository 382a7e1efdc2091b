"""Group C: order, ties and keys."""

import math

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, against_reference, assert_agrees, random_splats

import fidsplat as fs
from fidsplat.cameras import Camera
from fidsplat.scenes.random_clouds import load_scene, standard_camera
from fidsplat.selftest import clouds, order
from fidsplat.selftest.agreement import FrameSpec, differing, render, trace
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
    """numerics C1: rounding leaves few depths to 200 splats; otherwise the case decides nothing."""
    keys = trace(renderer, order.fronto_parallel(away))["keys"]
    assert len(np.unique(keys)) < 50


def test_a_tag_jumps_only_where_depth_decides(renderer):
    """Face to face, half of the depths change places within one step of 1e-4 degrees."""
    cloud = tag()
    before = largest_jump(renderer, camera_path(cloud, "centre", steps=2))[0]
    after = largest_jump(renderer, camera_path(cloud, "auto", steps=2))[0]
    assert before > 0.2
    assert after < 1e-4


def test_a_tag_before_a_wall_does_not_jump(renderer):
    """Ten times the step of the aim, and nothing but edges moves."""
    cloud = order.tag_before_wall(2000)
    for tilt in (0.0, 30.0, 60.0):
        before, after = (
            largest_jump(renderer, camera_path(cloud, order, 2, tilt, 54, 45, WALL_STEP))[0]
            for order in ("centre", "auto")
        )
        assert before > 0.15
        assert after < 10 * SMOOTH


@pytest.mark.parametrize("name", ["crossing", "fan"])
def test_splats_that_cross_do_not_jump(renderer, name):
    """Every splat by itself is what its picture alone shows, composited in the order of depths there."""
    cloud = getattr(order, name)(30)
    view = Camera.pinhole(40, 30, 40.0, 40.0, 20.0, 15.0)
    got, wanted = composited_parts(
        renderer, [subset_of(cloud, np.array([k])) for k in range(30)], view, "pixel"
    )
    assert np.abs(got - wanted).max() < 1e-5
    centre = composited_parts(renderer, [subset_of(cloud, np.array([k])) for k in range(30)], view, "centre")[
        0
    ]
    assert np.abs(centre - wanted).max() > 0.1


@pytest.mark.parametrize(
    "cloud",
    # the last has more in a tile than is looked at together
    [order.crossing(), order.fan(), order.crossing(200)],
    ids=["crossing", "fan", "many"],
)
def test_a_picture_does_not_depend_on_how_much_may_wait(renderer, cloud):
    """Room for one fragment at a pixel, or a few: the list is gone through again until the picture is the
    same, bit for bit."""
    picture = FrameSpec(cloud, clouds.camera(50, 40, 40.0), fs.Quality(order="pixel"), ALL_OUTPUTS)
    shapes = renderer.backend.shapes("k_buffer")
    wanted = trace(renderer, picture)
    for name, shape in shapes.items():
        assert differing(trace(renderer, picture, shape), wanted, picture.outputs) == 0, name


def _faint(count, seed, depth, scale, opacity=0.3, across=2.0):
    """Splats at random that let light through, so that all of a list is drawn."""
    generator = np.random.default_rng(seed)
    means = np.column_stack(
        [generator.uniform(-across, across, (count, 2)), generator.uniform(*depth, count)]
    )
    scales = np.exp(generator.uniform(*np.log(scale), (count, 2)))
    return splats(means, generator.normal(size=(count, 4)), scales, opacity, generator.random((count, 3)))


def _near_elsewhere() -> dict[str, fs.SplatCloud]:
    """Large splats, whose nearest points lie in other tiles than most of their fragments."""
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
        # more than are kept together
        "thousands": _faint(2600, 8, (1.0, 4.0), (1.0, 3.0), 0.01),
        "edge-on": edge_on,
        "through the camera": _faint(300, 9, (-0.5, 1.5), (0.5, 4.0), 0.05),
        "huge": _faint(300, 10, (1.0, 30.0), (50.0, 1000.0), 0.05),
        # as layers lie nearer than what of them is looked at
        "bent sheets": _faint(400, 13, (1.0, 3.0), (0.2, 0.8)).with_coplanar_groups(planes),
        "through a sheet": fs.SplatCloud.concatenate(
            [_faint(100, 7, (1.5, 4.0), (0.3, 1.5), 0.1), printed, _faint(200, 11, (2.5, 4.0), (0.3, 1.5))]
        ),
    }


NEAR_ELSEWHERE = _near_elsewhere()


@pytest.mark.parametrize("name", NEAR_ELSEWHERE)
def test_bounds_of_what_follows_hide_nothing(renderer, name):
    """Splats that are put in order for a tile, or looked at before they are drawn, are composited as where
    what waits is bounded by the whole splats' nearest depths: bit for bit."""
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("Warp's schedules have the same bounds, those of whole splats")
    views = {
        "thousands": clouds.camera(5, 4, 4.0),  # all are drawn, and groups hold eight
        "behind a fisheye": Camera.fisheye(34, 20, math.radians(100)),
    }
    view = views.get(name, clouds.camera(34, 20, 30.0))
    picture = FrameSpec(NEAR_ELSEWHERE[name], view, fs.Quality(order="pixel"), ("rgb", "depth", "normal"))
    groups = renderer.backend.shapes("schedule")["groups"]
    assert differing(trace(renderer, picture, groups), trace(renderer, picture), picture.outputs) == 0


def test_of_equal_depths_that_wait_the_first_is_in_front(renderer):
    """A column of pixels shows two splats of one depth before a wall; the next shows the second alone, before
    what waited first: there it is put further in front, here it is not."""
    column = 4 / 50  # of a pixel, at the depth of the wall
    cloud = fs.SplatCloud(
        # a wall whose nearest point is the nearest of all; a line across the next column, which leans forward
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
    """Against the sort of every pixel in float64; docs/correctness.md has what `-s` prints."""
    cloud, _ = load_scene("r100k_720p")
    camera, quality = standard_camera(320, 180), fs.Quality(order="pixel")
    differences = against_reference(renderer, FrameSpec(cloud, camera, quality, ("rgb", "depth")))
    print(renderer.device.name, *differences, sep="\n")
    assert all(difference.agrees for difference in differences)


def test_a_faint_splat_between_decides_nothing(renderer):
    """Drawn or not, with 1/255: a cut layer changed by 0.26."""
    with_it, without = (render(renderer, faint_between(n / 255))["rgb"] for n in (1.01, 0.99))
    assert 0 < np.abs(with_it - without).max() < 1.01 / 255


@pytest.mark.parametrize("side", order.SIDES)
def test_a_layer_lies_where_its_depth_says(renderer, side):
    """The big splat's centre alone would put it on the other side."""
    got, wanted = composited_parts(renderer, tag_and_large_splat(side), order.ON_TAGS)
    assert wanted.max() > 0.5
    assert np.abs(got - wanted).max() < 1e-6


def test_a_cutoff_moves_no_layer(renderer):
    """Tails of a tilted plane's splats, drawn or not, before a splat 2 mm behind it: bounded by what of a
    splat is not fainter than 1/255 they moved it back by 6 mm."""
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


def test_any_number_of_layers_wait(renderer):
    """Three sheets one behind the other, and a big splat between whose centre is nearer than all."""
    colors = np.eye(3)
    sheets = [
        splats([(0, 0, z)], (1, 0, 0, 0), 0.5, 0.6, colors[k]).with_coplanar_groups(0)
        for k, z in enumerate((2, 4, 6))
    ]
    view = Camera.pinhole(17, 17, 20.0, 20.0, 8.5, 8.5)
    got, wanted = composited_parts(renderer, [*sheets, splats([(0, 0, 5)], (1, 0, 0, 0), 2.0, 0.5)], view)
    assert np.abs(got - wanted).max() < 1e-6


@pytest.mark.parametrize("seed", [1, 2])
def test_planes_that_cross_each_other(renderer, seed):
    """More layers wait at a pixel than a backend may have room for, and one that ends lies before others."""
    cloud = random_splats(24, seed, depth=(0.8, 4.0), scale=(0.05, 0.5), across=1.2)
    cloud = cloud.with_coplanar_groups(np.arange(24) // 4 - 1)
    assert_agrees(renderer, cloud, Camera.pinhole(37, 22, 30.0, 30.0, 18.0, 11.0), ("rgb", "depth"))


def test_a_real_marker_does_not_jump(renderer):
    cloud = fs.marker("apriltag:36h11:5", size=1.0, mixture="fitted").cloud
    for tilt in (0.0, 40.0):
        assert largest_jump(renderer, camera_path(cloud, "auto", steps=3, tilt=tilt))[0] < SMOOTH
    assert largest_jump(renderer, camera_path(cloud, "centre", steps=3))[0] > 0.2
