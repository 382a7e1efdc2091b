"""Complete images against the float64 reference, from the same float32 inputs."""

import math

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, assert_agrees, compare, random_splats, reference_pixels
from derivative_errors import stretched

import fidsplat as fs
from fidsplat.cameras.pinhole import FOCAL_LENGTHS
from fidsplat.scenes.random_clouds import load_scene

CAMERA = fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
SMALL = stretched(fs.Camera.look_at(97, 71, 1.0, (0.7, -0.5, -0.4), (0.0, 0.1, 3.0), up=(0.4, -1.0, 0.1)))
"""for what takes the reference long: many splats, many samples; it is away from the origin, rolled, and its
pixels are not square"""


def one_splat(tilt_deg, turn_deg, scales=(0.3, 0.1), opacity=0.9, center=(0.1, -0.05, 2.0)):
    half_tilt, half_turn = math.radians(tilt_deg) / 2, math.radians(turn_deg) / 2
    # turn about the view axis, then tilt about x
    quat = np.array(
        [
            math.cos(half_tilt) * math.cos(half_turn),
            math.sin(half_tilt) * math.cos(half_turn),
            -math.sin(half_tilt) * math.sin(half_turn),
            math.cos(half_tilt) * math.sin(half_turn),
        ]
    )
    return fs.SplatCloud([center], [quat], [scales], [opacity], colors=[[0.9, 0.5, 0.2]], labels=3)


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0, 85.0, 89.9])
@pytest.mark.parametrize("turn", [0.0, 20.0, 45.0, 135.0])
def test_one_splat_at_twenty_poses(renderer, tilt, turn):
    assert_agrees(renderer, one_splat(tilt, turn), CAMERA)


def test_two_thousand_random_splats(renderer):
    cloud = random_splats(2000, seed=8, depth=(1.0, 6.0), scale=(1e-3, 0.3))
    assert_agrees(renderer, cloud, SMALL)


@pytest.mark.parametrize("quality", ["standard", "reference", "gsplat", "surfel"])
def test_splats_around_and_behind_the_camera(renderer, quality):
    assert_agrees(renderer, random_splats(200, seed=1), CAMERA, quality=quality)


def test_near_and_far_planes_amid_the_splats(renderer):
    """Complete disks are culled at the far plane, fragments at the near plane; disks that cross it are
    wide."""
    camera = fs.Camera.look_at(97, 71, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0), near=1.0, far=4.0)
    for seed in (1, 2):
        assert_agrees(renderer, random_splats(200, seed), camera)
    wall = fs.SplatCloud(
        [(0, 0, 5), (0, 0, 9)], [(1, 0, 0, 0)] * 2, [(5, 5)] * 2, [1, 1], colors=np.eye(3)[:2]
    )
    assert not renderer.render(wall, camera, ALL_OUTPUTS)["alpha"].any()


def test_splats_much_larger_than_the_image(renderer):
    assert_agrees(renderer, random_splats(200, seed=7, scale=(1e-3, 50.0)), CAMERA)


def test_splats_much_smaller_than_a_pixel(renderer):
    assert_agrees(renderer, random_splats(500, seed=7, depth=(1, 6), scale=(1e-6, 1e-2)), CAMERA)


@pytest.mark.parametrize(
    ("lowpass", "samples"), [("none", 1), ("none", 3), ("screen", 2), ("pixel", 1), ("pixel", 2)]
)
def test_lowpass_and_samples(renderer, lowpass, samples):
    quality = fs.Quality(lowpass=lowpass, samples=samples)
    camera = CAMERA if samples == 1 else SMALL
    assert_agrees(renderer, random_splats(100, seed=5), camera, quality=quality)


def test_fast_preset_is_as_accurate_as_its_constants(renderer):
    """Float32 projection costs accuracy (case B1): this preset is held to a tenth of an 8-bit step."""
    quality = fs.Quality.named("fast")
    cloud = random_splats(200, seed=0, depth=(0.5, 6.0))
    frame = renderer.render(cloud, CAMERA, quality=quality)
    expected = reference_pixels(cloud, CAMERA, ("rgb",), quality)
    excess = np.abs(frame["rgb"] - expected["rgb"]).max(2) - expected["error_bound"]
    assert np.quantile(excess, 0.999) < 0.1 / 255
    assert excess.max() < 2.0 / 255


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(renderer, degree):
    cloud = random_splats(200, seed=11, depth=(1, 6), scale=(0.02, 0.4), sh_degree=degree)
    camera = fs.Camera.look_at(97, 73, 1.1, (0.5, -0.4, -0.3), (0.0, 0.0, 3.0))
    assert_agrees(renderer, cloud, camera, outputs=("rgb",))


@pytest.mark.parametrize("tilt", [0, 20, 45, 60, 75])
@pytest.mark.parametrize(
    "spec", ["charuco:4x5:4x4_50", "qr-v5-L:" + "fidsplat " * 10], ids=["charuco", "qr5"]
)
def test_markers_at_five_tilts(renderer, spec, tilt):
    """at 400 pixels around the marker, oblong or square, against all of its splats, by a rolled camera."""
    cloud = fs.marker(spec, size=1.0, mixture="fitted").cloud
    angle = math.radians(tilt)
    position = (0.0, -2.2 * math.sin(angle), -2.2 * math.cos(angle))
    camera = fs.Camera.look_at(320, 240, 0.7, position, (0.0, 0.0, 0.0), up=(0.3, -1.0, 0.2))
    rows, columns = np.random.default_rng(tilt).integers((20, 60), (220, 260), (400, 2)).T
    outputs = ("rgb", "alpha", "depth", "normal")
    expected = reference_pixels(cloud, camera, outputs, "standard", pixels=(rows, columns))
    frame = renderer.render(cloud, camera, ALL_OUTPUTS)
    images = {name: frame[name][rows, columns] for name in outputs}
    differences = compare(images, expected, outputs)
    assert all(difference.agrees for difference in differences), differences
    assert expected["alpha"].mean() > 0.3


def test_principal_point_outside_the_image_and_odd_sizes(renderer):
    camera = fs.Camera.pinhole(53, 31, 60.0, 75.0, -20.5, 44.25)
    assert_agrees(renderer, random_splats(300, seed=2, depth=(0.5, 5), scale=(0.01, 0.5)), camera)


def test_no_sample_that_a_rim_just_reaches_is_lost(renderer):
    """Twenty disks whose lowest point is 2e-5 samples below the centre of a sample, in row 12,000 of an
    image, where float32 rounds a position to a thousandth: more than the relative margin of bounds."""
    quality, top = fs.Quality(lowpass="none", alpha_cutoff=1 / 255), 12_000
    samples = 5.0 * np.arange(20) - 46.5  # rows of their centres, from there
    radii = np.random.default_rng(1).uniform(0.15, 0.45, 20)
    places, focal, reach = samples - radii + 2e-5, 100.0, math.sqrt(2 * math.log(0.9 * 255))
    cloud = fs.SplatCloud(
        np.column_stack([0 * places, places / focal, 0 * places + 1]),
        np.tile([1.0, 0, 0, 0], (20, 1)),
        np.tile(radii[:, None] / focal / reach, (1, 2)),
        np.full(20, 0.9),
        colors=np.ones((20, 3)),
    )
    camera = fs.Camera.pinhole(1, 12_100, focal, focal, 0.5, top)
    alpha = renderer.render(cloud, camera, ALL_OUTPUTS, quality)["alpha"][:, 0]
    rows = np.flatnonzero(alpha)
    assert np.array_equal(rows, top + np.floor(samples).astype(int))
    assert alpha[rows] == pytest.approx(1 / 255, rel=1e-2)


@pytest.mark.parametrize("focal", FOCAL_LENGTHS)
def test_the_shortest_and_the_longest_focal_lengths(renderer, focal):
    """Extreme cameras that Camera accepts: splats that fill the sphere, or a pixel."""
    camera = fs.Camera.pinhole(41, 31, focal, focal, 20.0, 15.0)
    assert_agrees(renderer, random_splats(60, seed=3, depth=(2, 4), scale=(0.05, 0.8)), camera)


@pytest.mark.usefixtures("optimised")
def test_a_hundred_thousand_splats_at_720p(renderer):
    """r100k_720p at 300 pixels: at least 50 dB (the figure of its issue), and within the usual tolerance."""
    cloud, camera = load_scene("r100k_720p")
    generator = np.random.default_rng(1)
    pixels = generator.integers(0, camera.height, 300), generator.integers(0, camera.width, 300)
    expected = reference_pixels(cloud, camera, ALL_OUTPUTS, "standard", pixels=pixels)
    rgb = renderer.render(cloud, camera)["rgb"][pixels]
    error = np.abs(rgb - expected["rgb"]).max(1)
    psnr = -10 * math.log10(float((error**2).mean()))
    print(f"r100k_720p: {psnr:.1f} dB, largest error {error.max():.1e}")
    assert psnr > 50
    assert (error <= 2e-5 + expected["error_bound"]).all()


def coplanar_cloud(seed, count=60, planes=2):
    """Overlapping splats on a few tilted planes, and some of no plane between them."""
    generator = np.random.default_rng(seed)
    clouds = [random_splats(20, seed, depth=(1.5, 3.5), scale=(0.02, 0.2), across=0.8)]
    for _ in range(planes):
        flat = np.concatenate([generator.uniform(-0.6, 0.6, (count, 2)), np.zeros((count, 1))], 1)
        turns = generator.uniform(0, np.pi, count) / 2
        quats = np.stack([np.cos(turns), 0 * turns, 0 * turns, np.sin(turns)], 1)
        plane = fs.SplatCloud(
            flat,
            quats,
            generator.uniform(0.02, 0.3, (count, 2)),
            generator.choice([0.1, 0.6, 0.95, 1.0], count),
            colors=generator.uniform(0, 1, (count, 3)),
        ).with_coplanar_groups(0)
        pose = np.eye(4)
        axis = generator.normal(size=3) * 0.4
        pose[:3, :3] = rotation_about(axis)
        pose[:3, 3] = [0, 0, generator.uniform(1.8, 3.0)]
        clouds.append(plane.transformed(pose))
    return fs.SplatCloud.concatenate(clouds)


def rotation_about(axis):
    angle = np.linalg.norm(axis)
    x, y, z = axis / angle
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew


@pytest.mark.parametrize("seed", [0, 1, pytest.param(2, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize(("samples", "camera"), [(1, CAMERA), (2, SMALL)], ids=["1 sample", "2 x 2 samples"])
def test_coplanar_splats_are_one_layer(renderer, seed, samples, camera):
    cloud = coplanar_cloud(seed)
    assert cloud.has_coplanar_groups
    assert_agrees(renderer, cloud, camera, quality=fs.Quality(samples=samples))
    assert_agrees(renderer, cloud, camera, quality=fs.Quality(samples=samples, order="centre"))


def test_the_order_of_coplanar_splats_means_nothing(renderer):
    cloud = coplanar_cloud(5, planes=1)
    generator = np.random.default_rng(1)
    first = renderer.render(cloud, CAMERA, ALL_OUTPUTS)["rgb"]
    for _ in range(3):
        shuffle = generator.permutation(len(cloud))
        again = fs.SplatCloud(
            cloud.means[shuffle],
            cloud.quats[shuffle],
            cloud.scales[shuffle],
            cloud.opacities[shuffle],
            colors=cloud.colors[shuffle],
            origin=cloud.origin,
        ).with_coplanar_groups(cloud.coplanar_groups[shuffle])
        assert np.abs(renderer.render(again, CAMERA, ALL_OUTPUTS)["rgb"] - first).max() < 2e-5
