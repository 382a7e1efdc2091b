"""Behaviour of every device that users rely on: determinism, backgrounds, resident clouds, outputs,
errors."""

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, assert_agrees, random_splats

import fidsplat as fs

CAMERA = fs.Camera.look_at(130, 70, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))


def same(first, second, names):
    return all(np.array_equal(first[name], second[name]) for name in names)


def test_two_runs_are_bit_identical(renderer):
    cloud = random_splats(500, seed=3)
    first, second = (renderer.render(cloud, CAMERA, outputs=ALL_OUTPUTS) for _ in range(2))
    assert same(first, second, ALL_OUTPUTS)


def test_more_outputs_leave_rgb_as_it_was(renderer):
    cloud = random_splats(500, seed=4)
    alone = renderer.render(cloud, CAMERA)
    assert alone.outputs == ("rgb",)
    assert same(alone, renderer.render(cloud, CAMERA, outputs=ALL_OUTPUTS), ("rgb",))


def test_a_frame_keeps_its_images_when_the_next_is_rendered(renderer):
    first, second = random_splats(100, seed=6), random_splats(100, seed=7)
    frame = renderer.render(first, CAMERA)
    renderer.render(second, CAMERA)
    assert same(frame, renderer.render(first, CAMERA), ("rgb",))


def test_resident_cloud_renders_the_same(renderer):
    cloud = random_splats(100, seed=8)
    resident = renderer.upload(cloud)
    assert len(resident) == 100
    assert same(renderer.render(resident, CAMERA), renderer.render(cloud, CAMERA), ("rgb",))


def test_empty_cloud_is_background(renderer):
    empty = fs.SplatCloud(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 2)), np.zeros(0), colors=np.zeros((0, 3))
    )
    frame = renderer.render(empty, CAMERA, outputs=ALL_OUTPUTS, background=(0.25, 0.5, 0.75))
    assert np.array_equal(frame["rgb"], np.broadcast_to(np.float32([0.25, 0.5, 0.75]), (70, 130, 3)))
    assert not frame["alpha"].any()
    assert not frame["depth"].any()
    assert not frame["normal"].any()
    assert (frame["label"] == -1).all()
    assert frame.stats["pairs"] == 0


def test_everything_behind_the_camera_is_background(renderer):
    cloud = random_splats(100, seed=9, depth=(-6.0, -3.0), scale=(0.01, 0.1))
    frame = renderer.render(cloud, CAMERA)
    assert frame.stats["visible"] == 0
    assert not frame["rgb"].any()


def test_camera_inside_a_splat(renderer):
    """The camera's centre is in the plane of the disk and within it: an edge-on splat through the centre
    of projection."""
    cloud = fs.SplatCloud([[0, 0, 0]], [[0.5, 0.5, 0.5, 0.5]], [[1.0, 2.0]], [0.9], colors=[[1, 0, 0]])
    camera = fs.Camera.pinhole(40, 30, 30.0, 30.0, 20.0, 15.0)
    assert_agrees(renderer, cloud, camera)
    shifted = fs.Camera.look_at(40, 30, 1.0, (0.01, 0.0, 0.0), (0.0, 0.3, 1.0))
    assert_agrees(renderer, cloud, shifted)


def test_one_pixel_image(renderer):
    camera = fs.Camera.pinhole(1, 1, 1.0, 1.0, 0.5, 0.5)
    assert_agrees(renderer, random_splats(50, seed=10, depth=(0.5, 3)), camera)


def test_opaque_splats_hide_what_is_behind(renderer):
    """Case D1: with the inclusive stop and ceiling 1 nothing leaks; the parity presets leak 1 %."""
    cloud = fs.SplatCloud(
        [[0, 0, 1], [0, 0, 2]],
        [[1, 0, 0, 0]] * 2,
        [[0.5, 0.5]] * 2,
        [1.0, 1.0],
        colors=[[0, 0, 0], [1, 1, 1]],
    )
    camera = fs.Camera.pinhole(3, 3, 100.0, 100.0, 1.5, 1.5)
    assert renderer.render(cloud, camera)["rgb"][1, 1].max() < 1e-4
    leak = renderer.render(cloud, camera, quality="gsplat", background=(1, 1, 1))["rgb"][1, 1, 0]
    assert leak == pytest.approx(0.01, abs=1e-4)


def test_labels_depth_and_normals_of_a_wall(renderer):
    wall = fs.SplatCloud([[0, 0, 2.5]], [[1, 0, 0, 0]], [[5.0, 5.0]], [1.0], colors=[[1, 1, 1]], labels=42)
    camera = fs.Camera.pinhole(32, 24, 40.0, 40.0, 16.0, 12.0)
    frame = renderer.render(wall, camera, outputs=ALL_OUTPUTS)
    assert np.allclose(frame["depth"], 2.5, rtol=1e-6)
    assert np.allclose(frame["depth_median"], 2.5, rtol=1e-6)
    assert np.allclose(frame["normal"], (0, 0, -1), atol=1e-6)
    assert (frame["label"] == 42).all()


def test_timings_and_stats_name_the_work(renderer):
    frame = renderer.render(random_splats(100, seed=1), CAMERA)
    assert set(frame.stats) == {"splats", "visible", "pairs"}
    # GPUs resolve as they blend
    assert set(frame.timings) - {"resolve"} == {"project", "sort", "bin", "blend"}
    assert all(milliseconds >= 0 for milliseconds in frame.timings.values())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"outputs": ("rgb", "dept")}, ["'dept'", "'depth'"]),
        ({"quality": "standrad"}, ["'standrad'", "'standard'"]),
        ({"background": (0, 1)}, ["background", "three"]),
        ({"shutter": 0.01}, ["shutter must be", "a Shutter", "0.01"]),
        ({"motion": np.eye(4)}, ["motion must be", "a Motion"]),
        ({"fog": 0.0}, ["fog must be", "a Fog", "0.0"]),
        (
            {"quality": fs.Quality(samples=8), "camera": fs.Camera.pinhole(9000, 10, 1, 1, 1, 1)},
            ["9000", "32767"],
        ),
    ],
)
def test_bad_arguments_are_named(renderer, arguments, words):
    with pytest.raises(fs.InputError) as caught:
        renderer.render(random_splats(3, seed=1), **{"camera": CAMERA, **arguments})
    assert all(word in str(caught.value) for word in words)


def test_scene_without_camera_is_named(renderer):
    with pytest.raises(fs.InputError, match="camera"):
        renderer.render(random_splats(3, seed=1))


def test_cloud_of_another_renderer_is_refused(renderer, reference):
    with pytest.raises(fs.InputError, match="another Renderer"):
        renderer.render(reference.upload(random_splats(3, seed=1)), CAMERA)


@pytest.mark.parametrize(
    ("arguments", "word"), [({"camera": "front"}, "front"), ({"camera": CAMERA, "outputs": ()}, "outputs")]
)
def test_no_camera_and_no_outputs_are_named(renderer, arguments, word):
    with pytest.raises(fs.InputError, match=word):
        renderer.render(random_splats(3, seed=1), **arguments)


def test_the_reference_gives_the_types_of_a_device(renderer, reference):
    cloud = random_splats(3, seed=1)
    camera = fs.Camera.pinhole(4, 3, 4.0, 4.0, 2.0, 1.5)
    images, expected = (r.render(cloud, camera, outputs=ALL_OUTPUTS) for r in (renderer, reference))
    for name in ALL_OUTPUTS:
        assert images[name].dtype == expected[name].dtype, name
        assert not images[name].flags.writeable
