"""Images on a Warp tape: gradients through our rendering and through kernels of other programs; training
on Warp."""

import numpy as np
import pytest
from derivative_errors import derivatives, random_scene
from training_scene import QUICK, run_and_resumed, scene

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.cameras.pose_offset import offset_camera, offset_gradient
from fidsplat.train import Trainer

wp = pytest.importorskip("warp")
POSE = np.array([0.02, -0.05, 0.1, 0.03, -0.02, 0.04])
TYPES = {"means": "vec3", "quats": "vec4", "scales": "vec2", "opacities": "float32", "colors": "vec3"}


@wp.kernel
def squared(image: wp.array3d(dtype=float), expected: wp.array3d(dtype=float), loss: wp.array(dtype=float)):
    i, j, k = wp.tid()
    off = image[i, j, k] - expected[i, j, k]
    wp.atomic_add(loss, 0, off * off)


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("warp:cpu")


@pytest.fixture
def render():
    from fidsplat.train.warp_bridge import render

    return render


def picture():
    """As tests/contract/test_gradients.py renders, whose kernels it shares."""
    return random_scene(1, degree=None, quality="surfel", outputs=("rgb",), origin=(0.0, 0.0, 0.0))


def on_device(cloud, gradients=tuple(TYPES)):
    arrays = {name: getattr(cloud, name) for name in TYPES}
    types = TYPES
    if cloud.thickness is not None:
        arrays["scales"] = np.column_stack([cloud.scales, cloud.thickness])
        types = TYPES | {"scales": "vec3"}
    return {
        name: wp.array(array, dtype=getattr(wp, types[name]), device="cpu", requires_grad=name in gradients)
        for name, array in arrays.items()
    }


def test_a_tape_differentiates_frames_and_kernels(renderer, render):
    """All gradients are those of the backend by the same loss; a second pass adds to them."""
    cloud, capture = picture()
    arrays = on_device(cloud)
    expected = wp.zeros((43, 61, 3), dtype=float, device="cpu")
    loss = wp.zeros(1, dtype=float, device="cpu", requires_grad=True)
    tape = wp.Tape()
    with tape:
        images = render(tape, renderer, capture, **arrays)
        wp.launch(squared, (43, 61, 3), [images["rgb"], expected, loss], device="cpu")
    tape.backward(loss)
    rgb = images["rgb"].numpy()
    assert np.array_equal(rgb, renderer.render(cloud, capture)["rgb"])
    reference_images = derivatives(renderer.backend, cloud, capture, {"rgb": 2 * rgb})
    for name, array in arrays.items():
        assert np.abs(reference_images[name]).max() > 0
        np.testing.assert_array_equal(array.grad.numpy(), reference_images[name], err_msg=name)


def test_a_tape_differentiates_3d_gaussians(renderer, render):
    style = {"degree": None, "quality": "gsplat", "outputs": ("rgb",), "origin": (0.0, 0.0, 0.0)}
    cloud, capture = random_scene(0, solid=1.0, **style)
    arrays, ones = on_device(cloud), wp.ones((43, 61, 3), dtype=float, device="cpu")
    tape = wp.Tape()
    images = render(tape, renderer, capture, **arrays)
    for _ in range(2):
        tape.backward(grads={images["rgb"]: ones})
    expected = derivatives(renderer.backend, cloud, capture, {"rgb": ones.numpy()})
    expected["scales"] = np.column_stack([expected["scales"], expected["thickness"]])
    for name, array in arrays.items():
        np.testing.assert_array_equal(array.grad.numpy(), 2 * expected[name], err_msg=name)


def test_a_tape_has_the_gradients_of_pose_and_background(renderer, render):
    cloud, capture = picture()
    arrays = on_device(cloud, ("colors",))
    pose = wp.array(POSE, dtype=float, device="cpu", requires_grad=True)
    behind = wp.array([0.2, 0.3, 0.4], dtype=float, device="cpu", requires_grad=True)
    weights = np.random.default_rng(0).normal(size=(43, 61, 3)).astype(np.float32)
    tape = wp.Tape()
    images = render(tape, renderer, capture, **arrays, pose=pose, background=behind)
    tape.backward(grads={images["rgb"]: wp.array(weights, dtype=float, device="cpu")})
    at = pose.numpy().astype(np.float64)
    assert capture.camera
    there = capture.with_(camera=offset_camera(capture.camera, at), background=tuple(behind.numpy().tolist()))
    expected = renderer.render_differentiable(cloud, there).backward({"rgb": weights})
    np.testing.assert_array_equal(behind.grad.numpy(), expected["background"])
    np.testing.assert_allclose(
        pose.grad.numpy(), offset_gradient(expected["pose"].astype(float), at), rtol=1e-6
    )
    assert np.abs(expected["pose"]).min() > 0
    np.testing.assert_array_equal(arrays["colors"].grad.numpy(), expected["colors"])
    assert arrays["means"].grad is None


def test_what_a_tape_cannot_record_is_an_error(renderer, render):
    cloud, capture = picture()
    arrays, tape = on_device(cloud), wp.Tape()
    with pytest.raises(fs.DeviceError, match="must use a Warp device, got reference"):
        render(tape, fs.Renderer("reference"), capture, **arrays)
    with pytest.raises(fs.InputError, match="exactly one of colors"):
        render(tape, renderer, capture, **arrays, sh=arrays["colors"])
    with pytest.raises(fs.InputError, match=r"pose must be 6 numbers, got the shape \(7,\)"):
        render(tape, renderer, capture, **arrays, pose=np.zeros(7))
    with pytest.raises(fs.InputError, match="samples must be 1"):
        render(tape, renderer, capture.with_(quality="surfel,samples=2"), **arrays)
    images = render(tape, renderer, capture, **arrays)
    renderer.render(cloud, capture)
    with pytest.raises(fs.InputError, match="images of an earlier frame"):
        tape.backward(grads={images["rgb"]: wp.zeros((43, 61, 3), dtype=float, device="cpu")})


class Library:
    """An array library: reads DLPack, makes an array of a NumPy array, and has its address."""

    def __init__(self, name):
        if name == "numpy":
            self.read, self.make = np.from_dlpack, np.array
            self.address = lambda array: array.ctypes.data
        elif name == "warp":
            self.read, self.make = wp.from_dlpack, lambda given: wp.array(given, device="cpu")
            self.address = lambda array: array.ptr
        elif name == "torch":
            torch = pytest.importorskip("torch", reason="torch is not installed")
            self.read, self.make = torch.from_dlpack, torch.tensor
            self.address = lambda array: array.data_ptr()
        else:
            jax = pytest.importorskip("jax", reason="jax is not installed")
            self.read, self.make = jax.dlpack.from_dlpack, jax.numpy.asarray
            self.address = lambda array: array.unsafe_buffer_pointer()


@pytest.mark.parametrize("name", ["numpy", "warp", "torch", "jax"])
def test_other_libraries_share_the_memory(renderer, name):
    """The table of docs/backends.md: frames, batches, gradients and splats on the same device."""
    cloud, capture = picture()
    library, weights = Library(name), np.random.default_rng(2).normal(size=(43, 61, 3)).astype(np.float32)
    frame = renderer.render_differentiable(cloud, capture)
    rgb, shared = frame["rgb"], library.read(frame)
    assert library.address(shared) == frame.device_array("rgb").ptr
    expected = frame.backward({"rgb": weights})
    gradients = frame.backward({"rgb": library.make(weights)}, on_device=True)
    by_means = library.read(gradients["means"])
    assert library.address(by_means) == gradients["means"].ptr
    np.testing.assert_array_equal(np.from_dlpack(by_means), expected["means"])
    del frame
    batch = renderer.render_batch(cloud, [capture.with_(background=(1.0, 1.0, 1.0)), capture])
    np.testing.assert_array_equal(np.from_dlpack(shared), rgb)  # its memory is not used again
    both = library.read(batch)
    assert library.address(both) == batch.device_array("rgb").ptr
    np.testing.assert_array_equal(np.from_dlpack(both)[1], rgb)
    if name == "numpy":
        return  # NumPy arrays are copied
    splats = {part: library.make(np.array(getattr(cloud, part))) for part in TYPES}
    resident = renderer.wrap_arrays(**splats)
    np.testing.assert_array_equal(renderer.render(resident, capture)["rgb"], rgb)
    if name != "jax":  # whose arrays are immutable
        splats["colors"].numpy()[:] = 0.0
        assert np.abs(renderer.render(resident, capture)["rgb"] - rgb).max() > 0.01


def test_on_other_devices_arrays_of_the_host_are_read():
    cloud, capture = picture()
    frame = fs.Renderer("reference").render_differentiable(cloud, capture)
    weights = np.random.default_rng(2).normal(size=(43, 61, 3)).astype(np.float32)
    expected, actual = (frame.backward({"rgb": by}) for by in (weights, wp.array(weights, device="cpu")))
    np.testing.assert_array_equal(actual["means"], expected["means"])

    class Elsewhere:
        shape = (43, 61, 3)

        def __dlpack__(self, **options):
            raise BufferError("not on this device")

    with pytest.raises(fs.InputError, match=r"gradient of rgb must be on the host.*not on this device"):
        frame.backward({"rgb": Elsewhere()})


def test_derivatives_that_cannot_be_taken_are_errors(renderer):
    """Images in bands; arrays of another type, which would be read as something else."""
    cloud, capture = picture()
    backend = renderer.backend
    features, view = prepare(cloud, capture)
    pipeline, resident = backend.gradient_pipeline(features), backend.upload(cloud)
    images = pipeline.forward(resident, view)
    for wrong in (
        wp.zeros((43, 61, 3), dtype=wp.float64, device="cpu"),
        wp.zeros((43, 122, 3), dtype=float, device="cpu")[:, ::2],
    ):
        with pytest.raises(fs.InputError, match="must be a contiguous float32 array on cpu"):
            pipeline.backward(images, {"rgb": wrong})
    with pytest.raises(fs.InputError, match=r"of rgb must have the shape \(43, 61, 3\), got \(43, 61\)"):
        pipeline.backward(images, {"rgb": wp.zeros((43, 61), dtype=float, device="cpu")})
    before, backend.pair_budget = backend.pair_budget, images.stats["pairs"] - 1
    try:
        with pytest.raises(fs.DeviceError, match="must fit the memory budget without ranges of tiles"):
            pipeline.forward(resident, view)
    finally:
        backend.pair_budget = before


def test_training_on_warp_repeats_to_the_byte_and_after_a_stop(renderer, tmp_path):
    """3D Gaussians, trained by the step in NumPy, since Warp has no kernels for them."""
    settings = {**QUICK, "iterations": 20, "sh_degree": 0, "growth": 1.2, "primitive": "3d"}
    dataset = scene()
    uninterrupted = Trainer(dataset, renderer, **settings)
    before = np.mean([each.psnr for each in uninterrupted.evaluate(dataset.views)])
    uninterrupted.run()
    assert np.mean([each.psnr for each in uninterrupted.evaluate(dataset.views)]) > before + 1
    first, second = run_and_resumed(uninterrupted, renderer, settings, 11, tmp_path)
    assert first == second
