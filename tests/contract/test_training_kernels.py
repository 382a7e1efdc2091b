"""The kernels of a training step against their twins in NumPy, on every device that has some."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyopencl.array
import pytest
from derivative_errors import COSINE, NORM, derivatives, differences, random_loss, stretched
from training_scene import scene

import fidsplat as fs
from fidsplat.backends.gradients import on_host
from fidsplat.backends.opencl import training
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference.backend import ReferenceBackend
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.train import TrainSettings
from fidsplat.train.device_model import DeviceModel
from fidsplat.train.host_model import HostModel
from fidsplat.train.losses import image_loss
from fidsplat.train.optimiser import contributing, learning_rates
from fidsplat.train.parameters import NAMES, Splats
from fidsplat.util.errors import InputError

BACKEND = "opencl"
COUNT = 70
ORIGIN = np.array([30.0, -20.0, 12.0])


@pytest.fixture(scope="module")
def views():
    """Views of three sizes, not multiples of a vector; the second has a mask, the third has several pieces on
    CPUs."""
    sizes = (11, 9), (31, 18), (53, 71)
    small, wide, large = (scene(views=2, held_out=0, size=size).views[0] for size in sizes)
    mask = np.random.default_rng(0).uniform(size=(18, 31)) < 0.7
    return [small, replace(wide, mask=mask), large]


@pytest.fixture
def works(renderer, views):
    """Constructor of the kernels' training state and of its NumPy twin, with the same splats."""
    assert renderer.backend.has("training")

    def make(lanes=0, **changes):
        settings = TrainSettings(iterations=5, **changes)
        actual = (
            DeviceModel(training.OpenCLTraining(renderer.backend, lanes), views, settings),
            HostModel(renderer.backend, views, settings),
        )
        for work in actual:
            work.load(splats())
        return actual

    return make


def splats():
    random = np.random.default_rng(0)
    shapes = {"means": (3,), "log_scales": (2,), "quats": (4,), "logits": (), "sh": (16, 3)}
    cloud = Splats.of({name: random.normal(size=(COUNT, *shape)) for name, shape in shapes.items()})
    for group in (cloud.first, cloud.second):
        for array in group.values():
            array[:] = random.uniform(0.1, 1, array.shape)
    cloud.gradient_sums[:], cloud.visible_counts[:] = random.uniform(size=(2, COUNT))
    return cloud


def on_device(renderer, array):
    return pyopencl.array.to_device(renderer.backend.queue, np.ascontiguousarray(array, np.float32))


def rendered(renderer, image):
    """Images as a pipeline returns them."""
    array = on_device(renderer, image)
    return SimpleNamespace(device_buffer=lambda name: (array.data, array.shape), read=lambda name: image)


def agree(device, host, rtol=2e-5, atol=2e-6):
    device, host = device.read(), host.read()
    for group in ("values", "first", "second"):
        for name in NAMES:
            a, b = (getattr(each, group)[name] for each in (device, host))
            np.testing.assert_allclose(a, b, rtol=rtol, atol=atol, err_msg=f"{group} {name}")
    np.testing.assert_allclose(device.gradient_sums, host.gradient_sums, rtol=1e-6)
    np.testing.assert_array_equal(device.visible_counts, host.visible_counts)


@pytest.mark.parametrize(("weight", "lanes"), [(0.0, 0), (0.2, 0), (1.0, 0), (0.2, 1)])
def test_loss(renderer, views, works, weight, lanes):
    """Compare with float64 for images of two alternating sizes, whose buffers are reused; lanes=1 as on
    GPUs."""
    work, _ = works(lanes, dssim_weight=weight)
    random = np.random.default_rng(1)
    for number in (0, 1, 0, 2):
        expected = views[number].image / 255.0
        image = (expected + random.normal(0, 0.2, expected.shape)).astype(np.float32)
        value, slope = work.loss(rendered(renderer, image), number)
        actual = value()
        reference, wanted_slope = image_loss(image.astype(np.float64), expected, views[number].mask, weight)
        assert actual.value == pytest.approx(reference.value, rel=1e-5)
        assert actual.mse == pytest.approx(reference.mse, rel=1e-5)
        np.testing.assert_allclose(slope.get(), wanted_slope, rtol=1e-3, atol=2e-7)
        again, same = work.loss(rendered(renderer, image), number)
        assert (again(), same.get().tobytes()) == (actual, slope.get().tobytes())


def test_the_loss_is_summed_piece_by_piece(renderer, views, works, monkeypatch):
    """As of large images, where a work-item adds up more than one value."""
    monkeypatch.setattr(training, "_SUM_GROUPS", 2)
    work, _ = works(lanes=1)  # on CPUs it is summed strip by strip
    expected = views[0].image / 255.0
    image = (expected + np.random.default_rng(2).normal(0, 0.2, expected.shape)).astype(np.float32)
    actual = work.loss(rendered(renderer, image), 0)[0]()
    reference, _ = image_loss(image.astype(np.float64), expected, views[0].mask, TrainSettings().dssim_weight)
    assert actual.value == pytest.approx(reference.value, rel=1e-5)
    assert actual.mse == pytest.approx(reference.mse, rel=1e-5)


def test_masked_values_that_are_not_finite_do_not_count(renderer, views, works):
    work, _ = works()
    image = np.full((18, 31, 3), 0.5, np.float32)
    image[~views[1].mask] = np.nan
    value, slope = work.loss(rendered(renderer, image), 1)
    assert np.isfinite(value().value)
    assert not slope.get()[~views[1].mask].any()
    image[tuple(np.argwhere(views[1].mask)[0])] = np.nan
    assert np.isnan(work.loss(rendered(renderer, image), 1)[0]().value)


def test_loss_of_normals(renderer, views, works):
    """With a mask and without, holes among the depths."""
    device, host = works()
    random = np.random.default_rng(5)
    for number, (height, width) in enumerate(((9, 11), (18, 31))):
        normals = random.normal(size=(height, width, 3)).astype(np.float32)
        shown = {
            "depth": np.where(
                random.uniform(size=(height, width)) < 0.1, 0, random.uniform(1, 2, (height, width))
            ),
            "normal": normals / np.linalg.norm(normals, axis=2, keepdims=True),
            "alpha": random.uniform(size=(height, width)),
        }
        shown = {name: array.astype(np.float32) for name, array in shown.items()}
        images = SimpleNamespace(
            device_array=lambda name, shown=shown: on_device(renderer, shown[name]),
            read=lambda name, view, shown=shown: shown[name],
        )
        actual, expected = (work.normal_loss_gradients(images, number, 0.3) for work in (device, host))
        for name, array in expected.items():
            assert np.abs(array).max() > 0
            np.testing.assert_allclose(actual[name].get(), array, rtol=1e-4, atol=1e-5 * np.abs(array).max())


@pytest.mark.parametrize(
    ("strategy", "sparse", "lanes"),
    [
        ("default", False, 0),
        ("default", True, 0),
        ("mcmc", False, 0),
        ("default", False, 1),
        ("default", True, 1),
        ("mcmc", False, 1),
    ],
)
def test_a_step_and_its_frame(renderer, views, works, strategy, sparse, lanes):
    """By the derivatives that the same image has in arrays, which are the reference's. At degree 0, which
    has plain colours, then at degrees 2 and 3; a third of the splats are behind the camera but in the last
    step. Of a solid wall the image depends by its colour alone; in the second step, by depths, by its
    place; then, black, no more."""
    device, host = works(lanes, strategy=strategy, sh_degree=3, sparse_adam=sparse)
    near = stretched(views[2].camera)
    view = replace(views[2], camera=moved_by_origin(near))
    rate, counted = learning_rates(TrainSettings(), 100, 1.5), view.camera if strategy == "default" else None
    for step, degree in ((1, 0), (2, 0), (3, 2), (4, 3)):
        for work in (device, host):
            work.load(before_a_wall(near, 0.5 if step == 1 else -9.0, step < 4))
        shown = assert_equal_splats(renderer, device, host, degree, f"before step {step}", ORIGIN)
        by = ("depth",) if step == 2 else ("rgb",)
        frame_gradients = backpropagated(renderer, device, view, shown, lanes, by)
        gradients = {name: on_host(array) for name, array in frame_gradients.gradients().items()}
        capture = fs.Capture(view.camera, outputs=("rgb", "depth"), quality="surfel")
        features, visible = prepare(shown, capture)
        loss = random_loss(features, visible)
        cloud = host.read().cloud(degree, ORIGIN)
        expected = derivatives(ReferenceBackend(), cloud, capture, {name: loss[name] for name in by}, False)
        off = [one for one in differences(gradients, expected) if one.norm > NORM or one.turned > COSINE]
        assert not off, (step, off)
        idle = ~contributing(gradients)
        assert step == 4 or (idle[::3].all() and idle.mean() < 0.6)
        assert idle[1] == (step > 2)
        if step < 3:
            by = {name: bool(gradients[name][1].any()) for name in ("opacities", "colors", "means")}
            assert by == {"opacities": False, "colors": step == 1, "means": step == 2}
        before = host.read().select(np.flatnonzero(idle))
        device.step(frame_gradients, rate, step, counted, ORIGIN)
        host.step(gradients, rate, step, counted, ORIGIN)
        agree(device, host)
        assert_equal_splats(renderer, device, host, degree, f"after step {step}", ORIGIN)
        rested = device.read().select(np.flatnonzero(idle))
        same = [np.array_equal(rested.first[name], before.first[name]) for name in NAMES]
        assert all(same) == (sparse or not idle.any())


def moved_by_origin(camera):
    """The camera where clouds with that origin are, as splats relative to it are before this one."""
    matrix = camera.world_to_camera.copy()
    matrix[:3, 3] -= matrix[:3, :3] @ ORIGIN
    lens = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    return fs.Camera.pinhole(*lens, matrix, position=camera.position + ORIGIN)


def assert_equal_splats(renderer, device, host, degree, when, origin):
    """Whether the device and its NumPy twin render the same."""
    shown = [work.resident(degree, origin) for work in (device, host)]
    for name in ("means", "quats", "scales", "opacities", "sh" if degree else "colors"):
        a, b = (read(renderer, one, name).reshape(COUNT, -1) for one in shown)
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6, err_msg=f"{name} {when}")
    return shown[0]


def before_a_wall(camera, color=0.5, behind=True):
    """Small splats, each third behind the camera, before a solid wall that fills the image."""
    front = splats()
    front.values["means"][:] = np.random.default_rng(6).uniform(-0.5, 0.5, (COUNT, 3))
    front.values["log_scales"] -= np.float32(2.5)
    if behind:
        front.values["means"][::3] = 3 * camera.position
    front.values["means"][1] = -0.5 * camera.position
    front.values["log_scales"][1], front.values["logits"][1] = 4, 9
    front.values["quats"][1] = matrix_to_quaternion(camera.world_to_camera[:3, :3].T)
    front.values["sh"][1], front.values["sh"][1, 0] = 0, color
    return front


def backpropagated(renderer, device, view, resident, lanes, outputs=("rgb",)):
    """An image of splats on the device, taken back from a random loss of these outputs."""
    capture = fs.Capture(view.camera, outputs=("rgb", "depth"), quality="surfel")
    features, visible = prepare(resident, capture)
    shape = next(iter(renderer.backend.configs("schedule").values())) if lanes == 1 else None
    pipeline = renderer.backend.gradient_pipeline(features, shape)
    images = pipeline.forward(resident, visible)
    loss = random_loss(features, visible)
    return device.backward_per_tile(pipeline, images, {name: loss[name] for name in outputs})


@pytest.mark.parametrize("sparse", [False, True])
def test_a_resumed_run_renders_the_same(renderer, views, works, sparse):
    """In every bit: after a stop it is made again from the values."""
    rate, view = learning_rates(TrainSettings(), 100, 1.5), views[2]
    device, _ = works(sh_degree=3, sparse_adam=sparse)
    device.load(before_a_wall(view.camera))
    names = ("means", "quats", "scales", "opacities", "sh")
    for step in range(1, 6):
        gradients = backpropagated(renderer, device, view, device.resident(3, np.zeros(3)), 0)
        device.step(gradients, rate, step, None, np.zeros(3))
    went_on = [read(renderer, device.resident(3, np.zeros(3)), name) for name in names]
    device.load(device.read())
    for name, array in zip(names, went_on, strict=True):
        np.testing.assert_array_equal(read(renderer, device.resident(3, np.zeros(3)), name), array, name)


def test_a_step_by_an_outdated_frame_is_refused(renderer, views, works):
    device, _ = works(sh_degree=2)
    device.load(before_a_wall(views[2].camera))
    resident = device.resident(2, np.zeros(3))
    late, last = (backpropagated(renderer, device, views[2], resident, 0) for _ in range(2))
    means_before = device.read().values["means"].tobytes()
    with pytest.raises(InputError, match="before the next frame"):
        device.step(late, learning_rates(TrainSettings(), 100, 1.5), 1, None, np.zeros(3))
    with pytest.raises(InputError, match="before the next frame"):
        late.gradients()
    assert device.read().values["means"].tobytes() == means_before
    assert last.gradients()["means"].get().any()


def read(renderer, resident, name):
    buffer = resident.array_in_cloud_order(name, 0, COUNT)
    array = np.empty(buffer.size // 4, np.float32)
    renderer.backend.finish()
    pyopencl.enqueue_copy(renderer.backend.queue, array, buffer)
    return array


def test_visibility_statistics(renderer, views, works):
    """Where splats are made next, and do not move."""
    device, host = works()
    origin = np.array([0.2, 0.1, -0.3])
    for view in views:
        frame_gradients = backpropagated(renderer, device, view, device.resident(0, origin), 0)
        gradients = frame_gradients.gradients()
        device.accumulate_statistics(frame_gradients, view.camera, origin)
        host.accumulate_statistics(gradients, view.camera, origin)
    agree(device, host)
    statistics = device.read()
    assert statistics.values["means"].tobytes() == splats().values["means"].tobytes()
    assert (statistics.gradient_sums > splats().gradient_sums).any()
    counted = host.read().visible_counts - splats().visible_counts
    assert {0.0, 1.0, 2.0, 3.0} >= set(np.rint(counted).tolist()) > {0.0}


@pytest.mark.parametrize("axes", [2, 3])
def test_shaking(renderer, works, axes):
    device, host = works(strategy="mcmc", seed=2**40 + 7)
    if axes == 3:
        for work in (device, host):
            work.load(
                Splats.of(splats().values | {"log_scales": np.random.default_rng(1).normal(size=(COUNT, 3))})
            )
    before = host.read().values["means"].copy()
    for work in (device, host):
        work.add_noise(17, 1e-4)  # as after splats were made, when nothing of them has been rendered
    assert np.abs(host.read().values["means"] - before).max() > 0.01
    agree(device, host, atol=2e-5)


def test_what_was_loaded_is_stored(works):
    device, _ = works()
    stored, expected = device.read(), splats()
    for name in NAMES:
        np.testing.assert_array_equal(stored.values[name], expected.values[name])
        np.testing.assert_array_equal(stored.second[name], expected.second[name])
    assert len(device) == COUNT
    assert on_host(np.float64(1)).dtype == np.float32
