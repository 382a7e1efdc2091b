"""Every output on every device against the reference, and relations between the outputs."""

import math

import numpy as np
import pytest
from agreement import assert_agrees, random_splats

import fidsplat as fs
from fidsplat.effects import OUTPUTS

CAMERA = fs.Camera.look_at(81, 59, 1.0, (0.3, -0.2, -0.1), (0.0, 0.1, 3.0))
ALL = tuple(OUTPUTS)
KINDS = ("", "_median", "_first")


@pytest.mark.parametrize(("seed", "quality"), [(0, "standard"), (1, "reference"), (2, "gsplat")])
def test_outputs_of_splats_around_the_camera(renderer, seed, quality):
    assert_agrees(renderer, random_splats(150, seed), CAMERA, ALL, quality)


@pytest.mark.parametrize("samples", [2, 3])
def test_outputs_of_several_samples(renderer, samples):
    cloud = random_splats(100, 5, depth=(0.5, 5.0))
    assert_agrees(renderer, cloud, CAMERA, ALL, fs.Quality(samples=samples, first_hit=0.6))


@pytest.mark.parametrize("mixture", ["fitted", "exact"])
def test_outputs_of_layers(renderer, mixture):
    tag = fs.marker("aruco:4x4_50:7", size=1.0, mixture=mixture).cloud
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]
    pose[:3, 3] = (0.1, 0, 2.2)
    around = random_splats(40, seed=3, depth=(1.2, 3.5), scale=(0.02, 0.2), across=0.8)
    scene = fs.SplatCloud.concatenate([tag.transformed(pose), around])
    assert_agrees(renderer, scene, CAMERA, ALL)


def test_a_layer_shows_the_mean_of_what_its_splats_show(renderer):
    """Splats that are called a plane and are turned every way."""
    cloud = random_splats(40, seed=6, depth=(1.0, 3.0), scale=(0.2, 0.8), across=0.5)
    assert_agrees(renderer, cloud.with_coplanar_groups(np.arange(40) // 4), CAMERA, ALL)


@pytest.mark.parametrize("name", ALL)
def test_an_output_equals_itself_among_all_outputs(renderer, name):
    cloud = random_splats(150, 4)
    together, alone = (renderer.render(cloud, CAMERA, outputs) for outputs in (ALL, name))
    assert np.array_equal(alone[name], together[name])


def test_distances_are_depths_along_the_ray(renderer):
    """At one sample per pixel each is its depth times the length of the pixel's ray."""
    frame = renderer.render(random_splats(150, 6), CAMERA, ALL)
    rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width] + 0.5
    length = np.sqrt(1 + ((columns - CAMERA.cx) / CAMERA.fx) ** 2 + ((rows - CAMERA.cy) / CAMERA.fy) ** 2)
    for kind in KINDS:
        assert frame[f"distance{kind}"] == pytest.approx(frame[f"depth{kind}"] * length, rel=1e-6)
        assert (frame[f"depth{kind}"] > 0).any()


def test_normals_in_the_world_are_the_cameras_rotated(renderer):
    frame = renderer.render(random_splats(150, 6), CAMERA, ALL)
    turned = frame["normal"] @ CAMERA.world_to_camera[:3, :3]
    assert frame["normal_world"] == pytest.approx(turned, abs=1e-6)
    wall = fs.SplatCloud([(0, 0, 3)], [(1, 0, 0, 0)], [(9, 9)], [1.0], colors=[(1, 1, 1)])
    normals = renderer.render(wall, CAMERA, ALL)["normal_world"]
    assert normals[30, 40] == pytest.approx([0, 0, -1], abs=1e-6)


def layers_of(opacities, first=2.0, step=1.0):
    """Wide splats one metre (`step`) behind the other."""
    n = len(opacities)
    means = np.column_stack([np.zeros((n, 2)), first + step * np.arange(n)])
    return fs.SplatCloud(
        means,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 2), 50.0),
        opacities,
        colors=np.ones((n, 3)),
        labels=7 + np.arange(n),
    )


POINT = fs.Camera.pinhole(5, 5, 50.0, 50.0, 2.5, 2.5)


def test_ties_go_to_what_is_nearer(renderer):
    """Thresholds met exactly, by opacities that float32 has: half of the light, equal weights, the stop."""
    half = fs.Quality(opacity_ceiling=0.5)
    frame = renderer.render(layers_of([1, 1, 1]), POINT, ALL, half)
    assert frame["alpha"][2, 2] == 0.875
    assert frame["depth_median"][2, 2] == pytest.approx(2, rel=1e-6)  # half is left in front of the next
    frame = renderer.render(layers_of([0.5, 1.0]), POINT, ALL)
    assert renderer.render(layers_of([0.5]), POINT, ALL)["alpha"][2, 2] == 0.5
    assert (frame["label"][2, 2], frame["splat_id"][2, 2]) == (7, 0)
    first = half.with_(first_hit=0.5)
    assert renderer.render(layers_of([1, 1]), POINT, ALL, first)["depth_first"][2, 2] == 2
    gsplat = half.with_(stop_rule="exclusive", order="centre", transmittance_stop=0.25)
    for last in (1, 0.1):  # the pixel is finished, whatever comes behind the fragment that was dropped
        frame = renderer.render(layers_of([1, 1, last]), POINT, ALL, gsplat)
        assert (frame["alpha"][2, 2], frame["blended"][2, 2]) == (0.5, 1)


def test_a_pixel_ends_at_the_stop_whatever_its_neighbours_do(renderer):
    """Three layers have an opacity of 1/2; the second covers only the middle pixel, which stops there at a
    transmittance of exactly 1/4. The other pixels continue to the third."""
    quality = fs.Quality(opacity_ceiling=0.5, transmittance_stop=0.25, lowpass="none", alpha_cutoff=0.4)
    wide = layers_of([1, 1, 1])
    scales = wide.scales.copy()
    scales[1] = 0.5 * 3 / 50  # half a pixel
    layers = fs.SplatCloud(wide.means, wide.quats, scales, wide.opacities, colors=np.eye(3))
    frame = renderer.render(layers, POINT, ALL, quality)
    assert (frame["alpha"][2] == [0.75] * 5).all()
    assert (frame["blended"][2] == [2] * 5).all()
    assert frame["rgb"][2, 2].tolist() == [0.5, 0.25, 0]
    assert frame["rgb"][2, 0].tolist() == [0.5, 0, 0.25]


def test_of_equal_splats_in_a_layer_and_equal_samples_of_a_pixel_the_first_is_named(renderer):
    """Two copies in one plane; and two disks that each cover two of a pixel's four samples, with exactly half
    of the light: the left one's are read first. Of its samples a pixel takes the nearest first hit, and of
    their medians the lower."""
    twice = layers_of([0.5, 0.5, 0.5], step=0.0).with_coplanar_groups([0, 0, 0])
    frame = renderer.render(twice, POINT, ALL)
    assert (frame["label"][2, 2], frame["splat_id"][2, 2]) == (7, 0)

    # columns 2.75 and 2.25 of the image, row 2.5; within 1.2 sigma they are as opaque as the ceiling allows
    depths, sigma = np.array([2.0, 3.0]), 0.25 / 50
    sides = fs.SplatCloud(
        np.column_stack([np.array([0.25, -0.25]) / 50, [0, 0], [1, 1]]) * depths[:, None],
        np.tile([1.0, 0, 0, 0], (2, 1)),
        np.tile(depths[:, None] * sigma, (1, 2)),
        [1.0, 1.0],
        colors=np.ones((2, 3)),
        labels=[7, 8],
    )
    quality = fs.Quality(samples=2, lowpass="none", alpha_cutoff=0.4, opacity_ceiling=0.5, first_hit=0.4)
    frame = renderer.render(sides, POINT, ALL, quality)
    actual = {name: frame[name][2, 2] for name in ALL}
    assert (actual["alpha"], actual["label"], actual["splat_id"], actual["blended"]) == (0.5, 8, 1, 1)
    assert (actual["depth_first"], actual["depth_median"]) == pytest.approx((2, 2), rel=1e-6)
    assert actual["depth"] == pytest.approx(2.5, rel=1e-6)
    assert 2 < actual["distance_median"] == pytest.approx(actual["distance_first"], rel=1e-6)


def test_a_layer_of_a_thousand_faint_splats(renderer):
    """Each adds its optical depth, -ln(1 - opacity), not its opacity: the mix of colours shows it."""
    count = 1000
    opacities = np.append(np.full(count, 9.9e-4), 0.6)
    colors = np.append(np.tile([1.0, 0, 0], (count, 1)), [[0, 1.0, 0]], 0)
    wall = fs.SplatCloud(
        np.tile([0.0, 0, 2], (count + 1, 1)),
        np.tile([1.0, 0, 0, 0], (count + 1, 1)),
        np.full((count + 1, 2), 50.0),
        opacities,
        colors=colors,
    )
    rgb = renderer.render(wall.with_coplanar_groups(np.zeros(count + 1, int)), POINT, ALL)["rgb"][2, 2]
    red, green = -count * math.log1p(-9.9e-4), -math.log(0.4)
    assert rgb[0] / rgb[1] == pytest.approx(red / green, rel=1e-4)
    assert rgb[0] + rgb[1] == pytest.approx(1 - math.exp(-red - green), rel=1e-4)


def test_a_cutoff_below_all_floats(renderer):
    """Opacities that are 0 as float32 are in no layer's mean, which would be 0 / 0."""
    disk = fs.SplatCloud([(0, 0, 2)], [(1, 0, 0, 0)], [(0.05, 0.05)], [0.9], colors=[(1, 0.5, 0)])
    faint, fainter = (
        renderer.render(disk.with_coplanar_groups([0]), CAMERA, ("rgb", "blended"), quality)
        for quality in (fs.Quality(alpha_cutoff=cutoff, arithmetic="precise") for cutoff in (1e-20, 1e-300))
    )
    assert fainter["rgb"] == pytest.approx(faint["rgb"], abs=1e-6)
    assert faint["blended"].sum() < fainter["blended"].sum() < 0.6 * fainter["blended"].size


def test_a_wall_that_the_camera_is_almost_in(renderer):
    """Its centre 10^9 m ahead, its plane 0.1 m aside: it covers all that lies on that side."""
    wall = fs.SplatCloud([(-0.1, 0, 1e9)], [(0.5, 0.5, 0.5, 0.5)], [(1e9, 1e9)], [1.0], colors=[(1, 1, 1)])
    frame = renderer.render(wall, fs.Camera.pinhole(9, 9, 9.0, 9.0, 4.5, 4.5), ALL)
    assert frame["alpha"][:, :4] == pytest.approx(math.exp(-0.5), rel=1e-5)
    assert frame["depth"][4, :4] == pytest.approx(0.9 / (4.5 - np.arange(0.5, 4)), rel=1e-5)


@pytest.mark.parametrize(("first_hit", "depth"), [(0.15, 2), (0.25, 3), (0.4, 4), (0.6, 0)])
def test_the_first_hit_is_where_the_opacity_reaches_the_threshold(renderer, first_hit, depth):
    """Three layers of opacity 0.2 cover 0.2, 0.36 and 0.488."""
    quality = fs.Quality(first_hit=first_hit)
    frame = renderer.render(layers_of([0.2, 0.2, 0.2]), POINT, ALL, quality)
    assert frame["depth_first"][2, 2] == pytest.approx(depth, rel=1e-6)
    assert frame["blended"][2, 2] == 3


def test_an_opaque_layer_ends_the_count(renderer):
    frame = renderer.render(layers_of([0.2, 1.0, 0.2, 0.2]), POINT, ALL)
    assert (frame["blended"][2, 2], frame["splat_id"][2, 2]) == (2, 1)
    assert frame["blended"].dtype == frame["splat_id"].dtype == np.int32


def test_splat_ids_are_indices_of_the_cloud_in_slices_too(renderer):
    cloud = random_splats(3000, 8, depth=(1.0, 6.0), scale=(1e-3, 0.3))
    full_frame = renderer.render(cloud, CAMERA, ALL)
    ids = full_frame["splat_id"]
    assert ids.max() > 2000
    visible = ids >= 0
    assert np.array_equal(cloud.labels[ids[visible]], full_frame["label"][visible])
    if not renderer.device.name.startswith("opencl"):
        return  # Warp projects no cloud in slices (docs/backends.md)
    # a GPU's tables for projection in slices take more
    budget = 1_000_000 if renderer.device.kind == "cpu" else 3_000_000
    small = fs.Renderer(renderer.device.name, memory_budget=budget)
    resident = small.upload(cloud)
    resident.data._shared, resident.data.streamed = False, True
    assert np.array_equal(small.render(resident, CAMERA, "splat_id")["splat_id"], ids)
    assert "packed splats" in small.backend.pool._buffers


MASKED = (
    "label",
    "splat_id",
    "depth",
    "depth_median",
    "distance",
    "distance_median",
    "normal",
    "normal_world",
)
NOTHING = {"label": -1, "splat_id": -1}


def covered(frame, name):
    plane = frame[name] != NOTHING.get(name, 0)
    return plane.any(-1) if plane.ndim == 3 else plane


@pytest.mark.parametrize("samples", [1, 2])
def test_masks_do_not_grow_with_a_low_cutoff(renderer, samples):
    """They end where 1/255 is covered, whatever is rendered beyond it for the sake of colours."""
    splat = fs.SplatCloud([(0.1, 0.1, 3)], [(1, 0, 0, 0)], [(0.2, 0.3)], [0.9], colors=[(1, 1, 1)], labels=7)
    masks = {}
    for cutoff in (1 / 255, 1e-3, 1e-5):
        quality = fs.Quality(alpha_cutoff=cutoff, samples=samples)
        frame = renderer.render(splat, CAMERA, ALL, quality)
        masks[cutoff] = covered(frame, "label")
        for name in MASKED:
            assert np.array_equal(covered(frame, name), masks[cutoff]), name
        if samples == 1:
            assert np.array_equal(masks[cutoff], frame["alpha"] >= np.float32(1 / 255))
    assert 100 < masks[1e-5].sum() < (frame["alpha"] > 0).sum() - 100
    assert np.array_equal(masks[1e-5], masks[1e-3])
    assert np.array_equal(masks[1e-5], masks[1 / 255])


@pytest.mark.parametrize(("opacity", "count", "seen"), [(1e-3, 3, False), (1e-3, 5, True), (2e-3, 700, True)])
def test_haze_is_reported_once_it_covers_enough(renderer, opacity, count, seen):
    """However little each layer is; the median lies where half of the light is left, within the layers that
    count together.
    """
    frame = renderer.render(layers_of([opacity] * count), POINT, ALL)
    assert {name: bool(covered(frame, name)[2, 2]) for name in MASKED} == dict.fromkeys(MASKED, seen)
    if count > 100:
        half = math.log(0.5) / math.log(1 - opacity)
        assert 2 + half - 4 < frame["depth_median"][2, 2] < 2 + half + 1


def test_faint_fragments_behind_do_not_move_the_median(renderer):
    """The median is the last half-transparent layer, not a fragment of opacity 1/1000 far behind it."""
    cloud = layers_of([0.2, 0.1, 1e-3, 1e-3])
    frame = renderer.render(cloud, POINT, ALL)
    assert frame["blended"][2, 2] == 4
    assert frame["depth_median"][2, 2] == pytest.approx(3, rel=1e-6)
    for seed in range(3):
        assert_agrees(renderer, faint_splats(seed), CAMERA, ALL)


def faint_splats(seed):
    """Many splats that cover little each, before a few that do not."""
    cloud = random_splats(300, seed, depth=(1.0, 6.0), scale=(0.05, 1.0))
    generator = np.random.default_rng(seed)
    opacities = np.exp(generator.uniform(math.log(1e-4), math.log(0.05), len(cloud))).astype(np.float32)
    opacities[:10] = 0.7
    return fs.SplatCloud(
        cloud.means, cloud.quats, cloud.scales, opacities, colors=cloud.colors, labels=cloud.labels
    )


@pytest.mark.parametrize("value", [0, 1, -0.1, math.nan])
def test_thresholds_that_no_surface_has_are_refused(value):
    with pytest.raises(fs.InputError, match="first_hit"):
        fs.Quality(first_hit=value)
