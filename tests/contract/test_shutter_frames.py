"""Motion blur, rolling shutter and moving groups, against the reference and against images of single
poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from agreement import random_splats, some_thick
from sampling import SAMPLES, alternate
from test_agreement import coplanar_cloud

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference import ReferenceBackend
from fidsplat.capture.quality import Quality
from fidsplat.selftest.agreement import ALL_OUTPUTS, compare

SIZE = (61, 45)
BACKGROUND = (0.1, 0.2, 0.3)


def pose_at(time):
    """A camera that turns and moves on."""
    angle = 0.4 * time
    return fs.Camera.look_at(
        *SIZE, 1.0, (0.5 * time, -0.2 * time, -0.5), (3 * math.sin(angle), 0.1, 3 * math.cos(angle))
    ).world_to_camera


def turned(time):
    """A group that turns about (0, 0, 3) and moves to the right."""
    angle = 0.8 * time
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    matrix[0, 3] = 0.6 * time
    return matrix


CAMERAS = {
    "pinhole": fs.Camera.pinhole(*SIZE, 50.0, 50.0, 30.0, 22.0),
    "distortion": fs.Camera.pinhole(*SIZE, 50.0, 50.0, 30.0, 22.0, lens=fs.BrownConrady(-0.2, 0.05, p1=0.01)),
    "fisheye": fs.Camera.fisheye(*SIZE, math.radians(190)),
    "panorama": fs.Camera.equirectangular(*SIZE),
    "parallel": fs.Camera.orthographic(*SIZE, 4.0),
}
SHUTTERS = {
    "blur": fs.Shutter(exposure_time=0.3, sub_poses=5),
    "rolling": fs.Shutter(readout=0.5, rows_per_band=7),
    "both": fs.Shutter(time=0.2, exposure_time=0.2, sub_poses=2, readout=0.4, rows_per_band=16),
    "instant": fs.Shutter(time=0.4),
}
MOTION = fs.Motion(pose_at, {3: turned, 5: lambda time: turned(-time)})


def reference_images(cloud, camera, quality, outputs, motion, shutter):
    capture = fs.Capture(camera, (*outputs, "alpha"), quality, BACKGROUND, motion, shutter)
    features, view = prepare(cloud, capture)
    reference = ReferenceBackend()
    return reference.pipeline(features).render_view(reference.upload(cloud), view).arrays_of(0)


def assert_exposed(renderer, cloud, camera, motion, shutter, quality=None, outputs=ALL_OUTPUTS):
    quality = Quality.of(quality)
    frame = renderer.render(
        cloud, camera, outputs, quality, background=BACKGROUND, motion=motion, shutter=shutter
    )
    differences = compare(frame, reference_images(cloud, camera, quality, outputs, motion, shutter), outputs)
    assert all(difference.agrees for difference in differences), differences
    return frame


@pytest.mark.parametrize(("camera", "shutter"), alternate(CAMERAS, SHUTTERS))
def test_shutters_before_every_lens(renderer, camera, shutter):
    cloud = random_splats(150, 3, depth=(-2.0, 5.0), scale=(0.01, 0.5))
    assert_exposed(renderer, cloud, camera, MOTION, shutter)


@pytest.mark.parametrize("samples", [1, 2])
def test_moving_layers(renderer, samples):
    cloud = coplanar_cloud(1)
    labels = np.where(cloud.coplanar_groups < 0, 0, cloud.coplanar_groups + 3)
    motion = fs.Motion(None, {3: turned, 4: lambda time: turned(-time)})
    shutter = fs.Shutter(exposure_time=0.5, sub_poses=3)
    camera = CAMERAS["pinhole"]
    assert_exposed(renderer, cloud.with_labels(labels), camera, motion, shutter, Quality(samples=samples))


def test_normals_in_the_world_are_those_of_each_rows_pose(renderer):
    """A wall that does not move has one normal, however the camera turns while it is read out."""
    wall = fs.SplatCloud([(0, 0, 4)], [(0.97, 0.2, 0.1, 0)], [(9, 9)], [0.9], colors=[(1, 1, 1)])
    motion = fs.Motion(pose_at)
    outputs = (*ALL_OUTPUTS, "normal_world")
    frame = renderer.render(wall, CAMERAS["pinhole"], outputs, motion=motion, shutter=SHUTTERS["rolling"])
    first = frame["normal_world"][0, 0]
    assert np.linalg.norm(first) == pytest.approx(1, abs=1e-5)
    assert np.abs(frame["normal_world"] - first).max() < 1e-5
    assert np.abs(frame["normal"] - frame["normal"][0, 0]).max() > 0.05


def test_as_many_are_visible_as_in_the_fullest_pose(renderer):
    cloud, motion = random_splats(50, 3, depth=(1.0, 5.0)), fs.Motion(pose_at)
    frame = renderer.render(cloud, CAMERAS["pinhole"], motion=motion, shutter=SHUTTERS["blur"])
    assert 10 < frame.stats["visible"] <= 50


def test_colours_that_depend_on_the_view_rotate_with_their_group(renderer):
    """Of disks and of 3D Gaussians."""
    cloud = random_splats(100, 4, depth=(1, 5), scale=(0.05, 0.3), sh_degree=3)
    cloud = some_thick(cloud, np.where(np.arange(100) % 2 == 0, 0.1, 0))
    assert_exposed(renderer, cloud, CAMERAS["pinhole"], MOTION, SHUTTERS["both"], outputs=("rgb",))


def test_a_moved_group_is_the_transformed_cloud(renderer):
    still, moving = (
        random_splats(100, seed, depth=(1, 5), scale=(0.02, 0.3), sh_degree=2) for seed in (1, 2)
    )
    together = fs.SplatCloud.concatenate([still.with_labels(0), moving.with_labels(1)])
    motion, time = fs.Motion(None, {1: turned}), 0.7
    frame = renderer.render(together, CAMERAS["pinhole"], motion=motion, shutter=fs.Shutter(time=time))
    moved = fs.SplatCloud.concatenate([still.with_labels(0), moving.with_labels(1).transformed(turned(time))])
    plain = renderer.render(moved, CAMERAS["pinhole"])
    error = np.abs(frame["rgb"] - plain["rgb"]).max(2)
    assert np.quantile(error, 0.99) < 1e-4


def test_blur_is_the_mean_of_its_poses(renderer):
    cloud, camera = random_splats(100, 5, depth=(1, 5), scale=(0.02, 0.3)), CAMERAS["pinhole"]
    shutter = fs.Shutter(time=0.1, exposure_time=0.4, sub_poses=4)
    frame = renderer.render(cloud, camera, ALL_OUTPUTS, background=BACKGROUND, motion=MOTION, shutter=shutter)
    single = [
        renderer.render(
            cloud,
            camera,
            ALL_OUTPUTS,
            background=BACKGROUND,
            motion=MOTION,
            shutter=fs.Shutter(time=0.1 + t),
        )
        for t in (-0.15, -0.05, 0.05, 0.15)
    ]
    for name in ("rgb", "alpha"):
        np.testing.assert_allclose(frame[name], np.mean([one[name] for one in single], 0), atol=1e-6)
    assert (frame["depth"] == single[2]["depth"]).all()


def test_many_views_share_a_motion_and_a_shutter(renderer):
    cloud, outputs = random_splats(60, 5, depth=(1, 5), scale=(0.02, 0.3)), ("rgb", "depth")
    cameras = [CAMERAS["pinhole"], CAMERAS["distortion"]]
    motion, shutter = fs.Motion(None, {3: turned}), SHUTTERS["both"]
    views = renderer.render_views(cloud, cameras, outputs, motion=motion, shutter=shutter)
    scene = fs.Scene([cloud], shutter=shutter, camera_motion=pose_at)
    of_scene = renderer.render_views(scene, cameras, outputs)
    for camera, frame, moved in zip(cameras, views, of_scene, strict=True):
        single = renderer.render(cloud, camera, outputs, motion=motion, shutter=shutter)
        assert all(np.array_equal(frame[name], single[name]) for name in outputs)
        single = renderer.render(scene, camera, outputs)
        assert all(np.array_equal(moved[name], single[name]) for name in outputs)


@pytest.mark.parametrize(("lowpass", "samples"), alternate({"screen": "screen", "none": "none"}, SAMPLES))
def test_what_bands_leave_out_by_its_sphere_renders_nothing_there(renderer, lowpass, samples):
    """The same bits with and without `sub_frame_culling`: near, behind, large and far below a pixel."""
    cloud = random_splats(3000, 11, depth=(-2.0, 6.0), scale=(1e-4, 1.0), across=2.0)
    cloud = cloud.with_labels(np.arange(3000) % 7)
    cloud.opacities.flags.writeable = True
    cloud.opacities[::9] *= 4  # as of what stands for others in a store
    quality = Quality(lowpass=lowpass, samples=samples)
    camera, shutter = CAMERAS["pinhole"], fs.Shutter(readout=0.5, rows_per_band=3)
    capture = fs.Capture(camera, ALL_OUTPUTS, quality, BACKGROUND, MOTION, shutter)
    features, view = prepare(cloud, capture)
    assert "sub_frame_culling" in features.names
    without = replace(
        features, effects=tuple(name for name in features.effects if name != "sub_frame_culling")
    )
    backend = renderer.backend
    one, other = (
        backend.pipeline(each).render_view(backend.upload(cloud), view) for each in (features, without)
    )
    for name in ALL_OUTPUTS:
        assert np.array_equal(one.read(name), other.read(name)), name


def test_a_rolling_shutter_takes_each_row_at_its_own_time(renderer):
    cloud, camera = random_splats(100, 6, depth=(1, 5), scale=(0.02, 0.3)), CAMERAS["pinhole"]
    shutter = fs.Shutter(readout=0.8, rows_per_band=1)
    frame = renderer.render(cloud, camera, ALL_OUTPUTS, motion=MOTION, shutter=shutter)
    for row in (0, 17, 44):
        time = 0.8 * ((row + 0.5) / SIZE[1] - 0.5)
        single = renderer.render(cloud, camera, ALL_OUTPUTS, motion=MOTION, shutter=fs.Shutter(time=time))
        np.testing.assert_allclose(frame["rgb"][row], single["rgb"][row], atol=2e-5)


@pytest.mark.parametrize("rows", [1, 4, 15])
def test_bands_are_off_by_at_most_their_stated_bound(renderer, rows):
    """A bar that crosses the image while it is read out: its middle in each row, and where the time puts
    it."""
    height, speed, readout = 60, 40.0, 1.0
    camera = fs.Camera.pinhole(80, height, 100.0, 100.0, 40.0, 30.0)

    def across(time):
        matrix = np.eye(4)
        matrix[0, 3] = speed * time * 2.0 / 100.0  # at z = 2, `speed` pixels a second
        return matrix

    bar = fs.SplatCloud([[0, 0, 2.0]], [[1, 0, 0, 0]], [[0.04, 5.0]], [0.9], colors=[[1, 1, 1]], labels=1)
    frame = renderer.render(
        bar,
        camera,
        motion=fs.Motion(None, {1: across}),
        shutter=fs.Shutter(readout=readout, rows_per_band=rows),
    )
    light = frame["rgb"][..., 0].astype(float)
    middle = (light * (np.arange(80) + 0.5)).sum(1) / light.sum(1)
    want = 40 + speed * readout * ((np.arange(height) + 0.5) / height - 0.5)
    bound = speed * readout * (rows - 1) / (2 * height)
    error = np.abs(middle - want).max()
    # one sample of 1e-5 at the rim, 9.6 px from the middle, moves the mean of a bar of 4.5 px by 2e-5
    rim = 1e-4
    assert error <= bound + rim
    assert error >= 0.9 * bound - rim


def test_frames_are_bit_identical_again_and_in_bands_of_tiles(renderer):
    cloud, camera = random_splats(200, 7, depth=(-1, 5)), CAMERAS["fisheye"]

    def draw():
        frame = renderer.render(cloud, camera, ALL_OUTPUTS, motion=MOTION, shutter=SHUTTERS["both"])
        return [frame[name] for name in frame]

    first = draw()
    assert all((a == b).all() for a, b in zip(first, draw(), strict=True))
    held = renderer.backend.pair_budget
    renderer.backend.pair_budget = 60
    try:
        assert all((a == b).all() for a, b in zip(first, draw(), strict=True))
    finally:
        renderer.backend.pair_budget = held


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_rolling_shutters_of_a_tall_field_of_view_lose_no_splat(renderer, up):
    """Splats beyond the upper or lower border reach in along the depth, where rays are far from the axis."""
    random = np.random.default_rng(4)
    count, height = 600, 64
    depth = random.uniform(0.8, 1.2, count)
    slope = up * random.uniform(3.4, 5.0, count)  # the border is at 32 / 10
    means = np.column_stack([random.uniform(-1, 1, count), slope * depth, depth])
    shapes = random.normal(size=(count, 4)), np.full((count, 2), 0.1), np.full(count, 0.9)
    cloud = fs.SplatCloud(means, *shapes, colors=random.random((count, 3)))
    camera = fs.Camera.pinhole(24, height, 12.0, 10.0, 12.0, height / 2)
    capture = fs.Capture(
        camera, ("rgb", "alpha"), "alpha_cutoff=1e-6",
        motion=fs.Motion(lambda time: np.eye(4) + 0.02 * time * np.eye(4, k=3)),
        shutter=fs.Shutter(readout=0.5, rows_per_band=8),
    )  # fmt: skip
    expected = fs.Renderer("reference").render(cloud, capture)
    frame = renderer.render(cloud, capture)
    assert expected["alpha"].max() > 0.2
    for output in ("rgb", "alpha"):
        np.testing.assert_allclose(frame[output], expected[output], atol=2e-4)
