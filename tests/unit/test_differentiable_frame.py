"""Public gradients: `Renderer.render_differentiable`, camera pose offsets and the PyTorch bridge."""

import sys
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cameras.pose_offset import offset_camera, offset_gradient

CAMERA = fs.Camera.look_at(24, 18, 0.9, (0.2, 0.1, -2.0), (0.0, 0.0, 0.0))
OUTPUTS = ("rgb", "alpha", "depth")
ONES = np.ones((18, 24, 3), np.float32)
POSES = [np.zeros(6), np.array([1e-4, 0, 0, 0.1, 0, 0]), np.array([0.2, -0.5, 1.1, 0.3, -0.2, 0.4])]


def arrays(degree=None):
    random, n = np.random.default_rng(0), 6
    color = {"colors": random.uniform(0, 1, (n, 3))}
    if degree is not None:
        color = {"sh": random.normal(0, 0.3, (n, (degree + 1) ** 2, 3))}
    return {
        "means": random.uniform(-0.4, 0.4, (n, 3)),
        "quats": random.normal(size=(n, 4)),
        "scales": random.uniform(0.2, 0.4, (n, 2)),
        "opacities": random.uniform(0.4, 0.8, n),
        **color,
    }


def motion(pose):
    """(4, 4)."""
    still = fs.Camera.pinhole(4, 4, 4, 4, 2, 2)
    return offset_camera(still, pose).world_to_camera


def screw(matrix):
    """Rotation vector and translation of a small motion."""
    turn = matrix[:3, :3] - matrix[:3, :3].T
    return np.array([turn[2, 1] / 2, turn[0, 2] / 2, turn[1, 0] / 2, *matrix[:3, 3]])


@pytest.mark.parametrize("pose", POSES)
def test_derivatives_by_a_pose_are_those_of_central_differences(pose):
    """Gradient by a pose offset that is applied after a motion, compared with central differences."""
    by_motion, step = np.array([0.3, -1.2, 0.7, 2.0, 0.5, -0.9]), 1e-6
    back = np.linalg.inv(motion(pose))
    for k, actual in enumerate(offset_gradient(by_motion, pose)):
        ends = [screw(motion(pose + sign * step * np.eye(6)[k]) @ back) for sign in (1, -1)]
        assert actual == pytest.approx(by_motion @ (ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-8)


def test_a_rotation_vector_rotates_by_its_length():
    turned = motion(np.array([0, 0, np.pi / 2, 0, 0, 0]))
    np.testing.assert_allclose(turned[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


def test_gradients_of_a_frame_reach_a_pose_that_is_not_0():
    """Central differences of the float32 images; their rounding is 1e-4 of these derivatives."""
    renderer, cloud, pose = fs.Renderer("reference"), fs.SplatCloud(**arrays()), np.array(POSES[2] / 10)

    def rendered(at):
        return renderer.render_differentiable(cloud, offset_camera(CAMERA, at))

    frame = rendered(pose)
    weights = np.random.default_rng(1).normal(size=frame["rgb"].shape)
    actual = offset_gradient(frame.backward({"rgb": weights})["pose"], pose)
    for k in range(6):
        ends = [(weights * rendered(pose + sign * 1e-3 * np.eye(6)[k])["rgb"]).sum() for sign in (1, -1)]
        assert actual[k] == pytest.approx((ends[0] - ends[1]) / 2e-3, abs=5e-3 * np.abs(actual).max())


def test_an_effect_without_a_gradient_is_an_error_before_rendering():
    renderer, cloud = fs.Renderer("reference"), fs.SplatCloud(**arrays())
    with pytest.raises(fs.InputError, match="the output 'label' has no gradient"):
        renderer.render_differentiable(cloud, CAMERA, ("rgb", "label"))
    with pytest.raises(fs.InputError, match="samples must be 1"):
        renderer.render_differentiable(cloud, CAMERA, quality="samples=2")


def test_gradients_are_named_arrays_in_the_shapes_of_the_cloud():
    renderer, cloud = fs.Renderer("reference"), fs.SplatCloud(**arrays(degree=1))
    frame = renderer.render_differentiable(renderer.upload(cloud), CAMERA, OUTPUTS, distortion=True)
    assert isinstance(frame, fs.Frame)
    assert list(frame) == [*OUTPUTS, "distortion"]
    np.testing.assert_array_equal(frame["depth"], renderer.render(cloud, CAMERA, OUTPUTS)["depth"])
    gradients = frame.backward({"rgb": ONES, "distortion": ONES[..., 0]})
    shapes = {"means": (6, 3), "quats": (6, 4), "scales": (6, 2), "opacities": (6,), "sh": (6, 4, 3)}
    shapes |= {"background": (3,), "pose": (6,), "intrinsics": (4,), "grad2d": (6,)}
    assert {name: (array.shape, array.dtype) for name, array in gradients.items()} == {
        name: (shape, np.float32) for name, shape in shapes.items()
    }
    precise = frame.backward({"rgb": ONES, "distortion": ONES[..., 0]}, on_device=True)
    assert all(np.array_equal(array.astype(np.float32), gradients[name]) for name, array in precise.items())
    assert not any(array.any() for array in frame.backward({}).values())
    with pytest.raises(fs.InputError, match="the output 'normal' was not rendered"):
        frame.backward({"normal": ONES})


def test_3d_gaussians_have_gradients_by_their_thickness():
    given, renderer = arrays(), fs.Renderer("reference")
    given["scales"] = np.column_stack([given["scales"], [0.1, 0, 0.2, 0.3, 0, 0.1]])
    cloud = fs.SplatCloud(**given)
    actual = renderer.render_differentiable(cloud, CAMERA).backward({"rgb": ONES})
    assert actual["scales"].shape == (6, 2)
    np.testing.assert_array_equal(actual["thickness"] != 0, cloud.thickness > 0)


def test_a_store_has_no_gradients(tmp_path):
    fs.save_ply(fs.SplatCloud(**arrays()), str(tmp_path / "cloud.ply"))
    store = fs.Store(fs.build_store([str(tmp_path / "cloud.ply")], str(tmp_path / "cloud.fss")))
    with pytest.raises(fs.InputError, match=r"scene must be a SplatCloud .* got a store"):
        fs.Renderer("reference").render_differentiable(store, CAMERA)


def test_without_torch_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "fidsplat.train.torch_bridge", raising=False)
    with pytest.raises(fs.InputError, match=r"pip install 'fidsplat\[torch\]'"):
        import_module("fidsplat.train.torch_bridge")


class Tensor:
    """As much of PyTorch's as the bridge needs."""

    device = "cpu"

    def __init__(self, array):
        self.array = np.asarray(array)
        self.dtype, self.shape = self.array.dtype, self.array.shape

    def detach(self):
        return self

    cpu = detach

    def numpy(self):
        return self.array

    def to(self, device, dtype=None):
        return Tensor(self.array.astype(dtype or self.dtype, copy=False))

    def __len__(self):
        return len(self.array)


class Function:
    @classmethod
    def apply(cls, *given):
        cls.context = SimpleNamespace(set_materialize_grads=lambda whether: None)
        cls.context.needs_input_grad = [isinstance(each, Tensor) for each in given]
        return cls.forward(cls.context, *given)


def test_the_bridge_without_torch_itself(monkeypatch):
    """A replacement of PyTorch, which is too large for the tests: forward and backward."""
    torch = SimpleNamespace(
        autograd=SimpleNamespace(
            Function=Function, function=SimpleNamespace(once_differentiable=lambda f: f)
        ),
        nn=SimpleNamespace(functional=SimpleNamespace(normalize=lambda tensor, dim: tensor)),
        from_numpy=Tensor,
    )
    monkeypatch.setitem(sys.modules, "torch", torch)
    monkeypatch.setitem(sys.modules, "fidsplat.train.torch_bridge", None)  # what is there comes back
    del sys.modules["fidsplat.train.torch_bridge"]
    bridge = import_module("fidsplat.train.torch_bridge")
    renderer, given, pose = fs.Renderer("reference"), arrays(), POSES[2] / 10
    tensors = {name: Tensor(array) for name, array in (given | {"pose": pose}).items()}
    images = bridge.render(renderer, fs.Capture(CAMERA, OUTPUTS), **tensors)
    by_depth = np.random.default_rng(1).normal(size=(18, 24))
    context = bridge._Rendered.context
    context.needs_input_grad[3] = False  # quats
    back = bridge._Rendered.backward(context, None, None, Tensor(by_depth))

    frame = renderer.render_differentiable(fs.SplatCloud(**given), offset_camera(CAMERA, pose), OUTPUTS)
    expected = frame.backward({"depth": by_depth})
    expected["pose"] = offset_gradient(expected["pose"], pose)
    assert np.abs(expected["pose"]).min() > 0
    for name, image in images.items():
        np.testing.assert_array_equal(image.numpy(), frame[name])
        assert np.shares_memory(image.numpy(), context.frame[name])  # on the CPU without a second copy
    assert [each is None for each in back] == [True, True, False, True, *[False] * 3, True, True, False]
    for place, name in ((2, "means"), (4, "scales"), (5, "opacities"), (6, "colors"), (9, "pose")):
        np.testing.assert_array_equal(back[place].numpy(), expected[name])
    third = np.array([0.1, 0, 0.2, 0.3, 0, 0.1])
    solid = fs.SplatCloud(**given | {"scales": np.column_stack([given["scales"], third])})
    bridge.render(renderer, fs.Capture(CAMERA), **tensors | {"scales": Tensor(np.c_[given["scales"], third])})
    back = bridge._Rendered.backward(bridge._Rendered.context, Tensor(ONES))[4].numpy()
    expected = renderer.render_differentiable(solid, offset_camera(CAMERA, pose)).backward({"rgb": ONES})
    np.testing.assert_array_equal(back, np.column_stack([expected["scales"], expected["thickness"]]))
    tensors["scales"] = Tensor(
        given["scales"] * [[1], [0], [1], [1], [1], [1]]
    )  # one that cannot be rendered
    with pytest.warns(UserWarning, match="1 of 6 splats left out"):
        bridge.render(renderer, fs.Capture(CAMERA, OUTPUTS), **tensors)
    remaining = {name: array[[0, 2, 3, 4, 5]] for name, array in given.items()}
    frame = renderer.render_differentiable(fs.SplatCloud(**remaining), offset_camera(CAMERA, pose), OUTPUTS)
    expected = frame.backward({"rgb": ONES})
    back = bridge._Rendered.backward(bridge._Rendered.context, Tensor(ONES), None, None)
    for place, name in ((2, "means"), (4, "scales"), (5, "opacities"), (6, "colors")):
        np.testing.assert_array_equal(np.delete(back[place].numpy(), 1, 0), expected[name])
        assert not back[place].numpy()[1].any()
    with pytest.raises(fs.InputError, match="pose must be 6 numbers"):
        bridge.render(renderer, fs.Capture(CAMERA), **(tensors | {"pose": Tensor(np.zeros(7))}))


@pytest.mark.parametrize("degree", [None, 0, 1])
def test_tensors_have_the_gradients_of_the_backend(degree):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from fidsplat.train.torch_bridge import render

    renderer, given = fs.Renderer("reference"), arrays(degree)
    given |= {"background": np.array([0.2, 0.3, 0.4]), "pose": POSES[2] / 10}
    tensors = {name: torch.tensor(array, requires_grad=True) for name, array in given.items()}
    images = render(renderer, fs.Capture(CAMERA, OUTPUTS), **tensors)
    assert [tuple(image.shape) for image in images.values()] == [(18, 24, 3), (18, 24), (18, 24)]
    random = np.random.default_rng(1)
    weights = {name: random.normal(size=tuple(images[name].shape)) for name in ("rgb", "depth")}
    sum((torch.tensor(weights[name]) * images[name]).sum() for name in weights).backward()

    background, pose = given.pop("background"), given.pop("pose")
    capture = fs.Capture(offset_camera(CAMERA, pose), OUTPUTS, background=tuple(background))
    frame = renderer.render_differentiable(fs.SplatCloud(**given), capture)
    expected = frame.backward(weights)
    expected["pose"] = offset_gradient(expected["pose"], pose)
    if degree == 0:
        shade = 0.28209479177387814 * given["sh"][:, 0] + 0.5
        expected["sh"] = 0.28209479177387814 * (expected.pop("colors") * (shade > 0))[:, None]
    length = np.linalg.norm(given["quats"], axis=1, keepdims=True)
    expected["quats"] = expected["quats"] / length  # a cloud's are unit
    for name, image in images.items():
        np.testing.assert_allclose(image.detach().numpy(), frame[name], rtol=1e-5, atol=1e-6)
    for name, tensor in tensors.items():
        np.testing.assert_allclose(tensor.grad.numpy(), expected[name], rtol=1e-4, atol=1e-5)


def test_tensors_are_fitted_to_an_image():
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from fidsplat.train.torch_bridge import render

    renderer, given, capture = fs.Renderer("reference"), arrays(), fs.Capture(CAMERA)
    expected = torch.tensor(renderer.render(fs.SplatCloud(**given), capture)["rgb"])
    tensors = {name: torch.tensor(array, dtype=torch.float32) for name, array in given.items()}
    tensors["colors"] = torch.full((6, 3), 0.5, requires_grad=True)
    optimiser, losses = torch.optim.Adam([tensors["colors"]], lr=0.1), []
    for _ in range(15):
        optimiser.zero_grad()
        loss = ((render(renderer, capture, **tensors)["rgb"] - expected) ** 2).mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
