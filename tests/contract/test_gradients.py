"""Derivatives of every device against the reference's in float64, and bit-identical results on every run."""

import math
import threading
import weakref

import numpy as np
import pyopencl as cl
import pytest
from derivative_errors import (
    COSINE,
    NORM,
    arrays_of,
    certain_loss,
    colors_of,
    conditioning,
    derivatives,
    differences,
    random_loss,
    random_scene,
    reference_derivatives,
    rotation_floor,
)

import fidsplat as fs
from fidsplat.backends.gradients import CapacityExceeded, on_host
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference.backend import ReferenceBackend
from fidsplat.effects.differentiable import with_distortion

BACKEND = ("opencl", "warp")


def assert_same(backend, cloud, capture, by_images=None, **build):
    by_images = certain_loss(cloud, capture) if by_images is None else by_images
    actual = derivatives(backend, cloud, capture, by_images, **build)
    expected = reference_derivatives(cloud, capture, by_images)
    assert actual.keys() == expected.keys()
    for name, array in actual.items():
        assert array.shape == expected[name].shape, name
    off = list(differences(actual, expected, rotation_floor(cloud, expected)))
    if not all(one.norm <= NORM and one.turned <= COSINE for one in off):  # also for NaN
        for one, known in zip(off, conditioning(cloud, capture, by_images), strict=True):
            assert one.norm <= NORM or one.norm <= known.norm < math.inf, (one, known)
            assert one.turned <= max(COSINE, known.turned), (one, known)
    return actual


CASES = {
    "random": {},
    "degree 2, portrait": {"degree": 2, "size": (29, 53)},
    "degree 3": {"degree": 3},
    "plain colours, surfel": {"degree": None, "quality": "surfel", "outputs": ("rgb",)},
    "far below a pixel": {"scale": (1e-5, 1e-3), "depth": (1.0, 5.0), "across": 1.0},
    "huge": {"scale": (1.0, 50.0), "depth": (0.5, 4.0), "count": 30},
    "needles": {"scale": (1e-4, 5.0), "depth": (1.0, 4.0)},
    "around the camera": {"depth": (-0.5, 0.5), "across": 0.5, "scale": (1e-2, 1.0)},
}


@pytest.fixture
def backend(renderer):
    assert renderer.backend.has("gradient_pipeline")
    return renderer.backend


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_the_references(backend, case):
    gradients = assert_same(backend, *random_scene(1, **CASES[case]))
    assert all(np.abs(array).max() > 0 for array in gradients.values())


@pytest.mark.parametrize("seeds", [(0, 1, 31), pytest.param(range(200), marks=pytest.mark.exhaustive)])
def test_derivatives_of_random_scenes_are_the_references(backend, seeds):
    for seed in seeds:
        assert_same(backend, *random_scene(seed))


def spheres(cloud, capture):
    """3D Gaussians whose scales are equal: no derivative by rotation is left but rounding."""
    means, quats, scales, opacities = arrays_of(cloud)
    scales = np.repeat(scales[:, :1], 3, axis=1)
    return fs.SplatCloud(means, quats, scales, opacities, origin=cloud.origin, **colors_of(cloud)), capture


@pytest.mark.parametrize(
    ("projection", "solid"), [("ewa_antialiased", 1.0), ("exact", 0.7)], ids=["EWA", "exact, and disks"]
)
def test_derivatives_of_3d_gaussians_are_the_references(backend, projection, solid):
    quality = fs.Quality(ellipsoid=projection)
    scenes = [
        random_scene(0, solid=solid, quality=quality),
        random_scene(1, solid=solid, quality=quality, scale=(3e-3, 0.03), depth=(1.0, 5.0)),
        random_scene(2, solid=solid, quality=quality, scale=(1e-2, 1.0), depth=(-0.5, 1.5), across=0.5),
        spheres(*random_scene(1, solid=1.0, quality=quality)),
    ]
    for cloud, capture in scenes:
        loss = certain_loss(cloud, capture)
        gradients = assert_same(backend, cloud, capture, loss)
        again = derivatives(backend, cloud, capture, loss)
        for name, array in gradients.items():
            assert array.any(), name
            assert array.tobytes() == again[name].tobytes(), name
    (shape,) = backend.configs("schedule").values()
    if projection == "exact":
        assert_same(backend, *scenes[2], config=shape)


def test_the_schedule_of_gpus_has_the_references_derivatives(backend):
    for shape in backend.configs("schedule").values():
        assert_same(backend, *random_scene(2), config=shape)
        assert_same(backend, *long_lists(), config=shape)


def test_distortions_and_their_derivatives_are_the_references(backend):
    """Of splats a thousandth of their depth apart, far apart, and before the depth buffer. The derivatives by
    distortions are small beside others, and are requested by themselves."""
    near = {"depth": (0.1, 0.4), "scale": (0.1, 1.0), "across": 0.3}
    cases: list[dict] = [{"depth": (2.0, 2.002)}, {"depth": (0.3, 30.0), "scale": (0.1, 1.0)}, near]
    for case in cases:
        cloud, capture = random_scene(3, **case)
        by_distortion = {"distortion": np.random.default_rng(1).normal(size=(43, 61)).astype(np.float32)}
        assert_same(backend, cloud, capture, by_distortion)
        features, view = prepare(cloud, capture)
        loaded, expected = (
            each.gradient_pipeline(with_distortion(features))
            .forward(each.upload(cloud), view)
            .read("distortion", 0)
            for each in (backend, ReferenceBackend())
        )
        assert expected.max() > 0
        assert np.abs(loaded - expected).max() < 1e-4 * expected.max()


def test_opaque_splats_have_derivatives(backend):
    """Nothing shines through them, and their own opacity counts."""
    cloud, capture = random_scene(3, scale=(0.3, 1.0), depth=(1.5, 4.0))
    opaque = fs.SplatCloud(
        cloud.means, cloud.quats, cloud.scales, np.ones(90), sh=cloud.sh, origin=cloud.origin
    )
    gradients = assert_same(backend, opaque, capture)
    assert np.abs(gradients["opacities"]).max() > 0
    assert all(np.isfinite(array).all() for array in gradients.values())


@pytest.mark.parametrize("solid", [0.0, 1.0], ids=["disks", "exact 3D Gaussians"])
def test_scales_below_the_smallest_have_no_derivative_and_leave_others_theirs(backend, solid):
    """Splats with every combination of tiny scales, from none to all."""
    quality = fs.Quality(ellipsoid="exact") if solid else None
    shape = {"scale": (0.05, 0.3), "depth": (1.5, 4.0), "solid": solid, "quality": quality}
    cloud, capture = random_scene(5, count=40, **shape)
    third = [] if cloud.thickness is None else [cloud.thickness]
    scales = np.column_stack([cloud.scales, *third])
    tiny = np.arange(40)[:, None] // [1, 2, 4][: scales.shape[1]] % 2 == 1
    means, quats, _, opacities = arrays_of(cloud)
    scales = np.where(tiny, np.float32(1e-25), scales)
    thin = fs.SplatCloud(means, quats, scales, opacities, sh=cloud.sh, origin=cloud.origin)
    gradients = assert_same(backend, thin, capture)
    for axis, by in enumerate([*gradients["scales"].T, *([gradients["thickness"]] if solid else [])]):
        assert not by[tiny[:, axis]].any()
        assert by[~tiny[:, axis]].any()


def long_lists():
    """Hundreds of faint splats in each tile, in windows and beyond them: light is left at the end."""
    cloud, capture = random_scene(
        4, count=400, scale=(0.2, 1.5), depth=(2.0, 5.0), across=1.0, size=(150, 40)
    )
    opacities = 0.004 + 0.01 * cloud.opacities
    faint = fs.SplatCloud(cloud.means, cloud.quats, cloud.scales, opacities, sh=cloud.sh, origin=cloud.origin)
    return faint, capture


@pytest.mark.sweep
def test_long_lists_are_taken_back_in_segments(backend):
    gradients = assert_same(backend, *long_lists())
    for shape in backend.configs("tape").values():
        again = assert_same(backend, *long_lists(), config=shape)
        assert all(np.array_equal(again[name], gradients[name]) for name in gradients)


def test_the_same_bits_on_every_run_and_those_of_render(backend, renderer):
    cloud, capture = random_scene(5, count=400)
    first, again = derivatives(backend, cloud, capture), derivatives(backend, cloud, capture)
    for name, array in first.items():
        assert array.tobytes() == again[name].tobytes(), name
    features, view = prepare(cloud, capture)
    images = backend.gradient_pipeline(with_distortion(features)).forward(backend.upload(cloud), view)
    drawn = {name: images.read(name, 0) for name in capture.outputs}
    frame = renderer.render(cloud, capture)
    assert all(np.array_equal(drawn[name], frame[name]) for name in drawn)


def test_a_differentiable_frame_has_the_bits_of_render_and_of_the_backends_gradients(backend, renderer):
    cloud, capture = random_scene(5)
    expected = derivatives(backend, cloud, capture, distorted=False)
    weights = random_loss(*prepare(cloud, capture))
    frame = renderer.render_differentiable(cloud, capture)
    gradients = frame.backward(weights)
    images, rendered = dict(frame), renderer.render(cloud, capture)
    assert all(np.array_equal(images[name], rendered[name]) for name in rendered)
    assert all(gradients[name].tobytes() == array.tobytes() for name, array in expected.items())
    assert gradients.keys() == expected.keys()
    resident = renderer.upload(cloud)
    on_device = renderer.render_differentiable(resident, capture).backward(weights, on_device=True)
    assert all(np.array_equal(on_host(array), gradients[name]) for name, array in on_device.items())
    with pytest.raises(fs.InputError, match="images of an earlier frame"):
        frame.backward(weights)


def test_frames_that_are_not_awaited_have_the_same_derivatives(backend, renderer):
    """Where lists are made before their length is known, one that had too little room says so when it is
    taken back, and the next has enough."""
    (shape,) = backend.configs("schedule").values()
    few, crowd = random_scene(2), random_scene(2, count=3000, scale=(0.2, 1.0))
    pipeline = backend.gradient_pipeline(with_distortion(prepare(*few)[0]), config=shape)

    def backpropagated(cloud, capture, waits):
        features, view = prepare(cloud, capture)
        images = pipeline.forward(backend.upload(cloud), view, waits)
        gradients = pipeline.backward(images, random_loss(features, view))
        return {name: on_host(array).tobytes() for name, array in gradients.items()}

    first = backpropagated(*few, waits=True)
    assert backpropagated(*few, waits=False) == first
    if renderer.device.name.startswith("opencl"):
        with pytest.raises(CapacityExceeded):
            backpropagated(*crowd, waits=False)
    many = backpropagated(*crowd, waits=True)
    assert backpropagated(*crowd, waits=False) == many
    assert backpropagated(*few, waits=False) == first


def test_a_cloud_outlives_what_is_under_way(renderer, backend):
    """A processor reads the host's arrays: they go when no one reads them any more."""
    if renderer.device.kind != "cpu" or not renderer.device.name.startswith("opencl"):
        pytest.skip("reads no arrays of the host, or does not work beside it")
    reported, (cloud, capture) = [], random_scene(6)
    weakref.finalize(cloud.quats, reported.append, "gone")
    features, view = prepare(cloud, capture)
    gradients, resident = backend.gradient_pipeline(features), backend.upload(cloud)
    images = gradients.forward(resident, view)
    images.read("rgb")
    held = cl.UserEvent(backend.context)
    cl.enqueue_barrier(backend.queue, wait_for=[held])
    gradients.backward(images, random_loss(features, view))

    def go_on():
        reported.append("read")
        held.set_status(cl.command_execution_status.COMPLETE)

    threading.Timer(0.2, go_on).start()
    del cloud, resident, images
    assert reported == ["read", "gone"]


def test_outputs_without_a_gradient_given_have_one_of_zero(backend):
    cloud, capture = random_scene(6)
    features, view = prepare(cloud, capture)
    weights = random_loss(features, view)
    alone = derivatives(backend, cloud, capture, {"rgb": weights["rgb"]})
    zeros = {name: 0 * array for name, array in weights.items()} | {"rgb": weights["rgb"]}
    beside = derivatives(backend, cloud, capture, zeros)
    for name in alone:
        assert np.array_equal(alone[name], beside[name]), name


def test_derivatives_are_timed_and_another_frame_in_between_is_an_error(backend, renderer):
    cloud, capture = random_scene(6)
    features, view = prepare(cloud, capture)
    pipeline = backend.gradient_pipeline(with_distortion(features))
    images = pipeline.forward(backend.upload(cloud), view)
    pipeline.backward(images, {})
    assert {"blend", "blend backward", "project backward"} <= images.timings.keys()
    assert all(isinstance(name, str) and ms >= 0 for name, ms in images.timings.items())
    renderer.render(cloud, capture)
    with pytest.raises(fs.InputError, match="images of an earlier frame"):
        pipeline.backward(images, {})


def test_a_frame_without_a_visible_splat_has_the_backgrounds_derivative(backend):
    """No splat at all, or all of them behind the camera."""
    cloud, capture = random_scene(7)
    behind = fs.SplatCloud(
        cloud.means - (0.0, 0.0, 40.0), cloud.quats, 0.1 * cloud.scales, cloud.opacities, sh=cloud.sh,
        origin=cloud.origin,
    )  # fmt: skip
    gradients = assert_same(backend, behind, capture)
    assert gradients["background"].any()
    assert not gradients["means"].any()
    empty = fs.SplatCloud(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 2)), [], sh=np.zeros((0, 4, 3)))
    assert_same(backend, empty, capture)
