"""A backend from outside the tree: one line in the registry makes it usable everywhere."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.accuracy.error import supports_float64
from fidsplat.backends import registry

CAMERA = fs.Camera.pinhole(6, 4, 6.0, 6.0, 3.0, 2.0)
CLOUD = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[0.3, 0.3]], [0.9], colors=[[1.0, 0.5, 0.25]])
TOY = """
import numpy as np
from fidsplat.backends import interface
from fidsplat.effects import OUTPUTS
from fidsplat.util.errors import DeviceError

INFO = interface.DeviceInfo("toy", "Toy", "Toys", "1", "other", 1, 1, 1, False, True, "")


def devices():
    return [INFO]


def open_device(selector):
    return Backend()


class Cloud(interface.DeviceCloud):
    memory_bytes = 0

    def __init__(self, cloud):
        self.count = len(cloud)
        self.copy_properties(cloud)


class Backend(interface.Backend):
    info = INFO

    def upload(self, cloud):
        return Cloud(cloud)

    def unsupported(self, features):
        lacking = {*features.outputs, *features.post_steps, *features.effects[8:]} - {"alpha"}
        return f"toy has no {', '.join(sorted(lacking))}" if lacking else ""

    def pipeline(self, features, config=None):
        if why := self.unsupported(features):
            raise DeviceError(why)
        return Pipeline()


class Pipeline(interface.Pipeline):
    def render_view(self, resident, view):
        return Images(view, resident.count)


class Images(interface.Images):
    def __init__(self, view, count):
        self.view, self.timings, self.stats = view, {"toy": 0.0}, {"splats": count, "visible": 0, "pairs": 0}

    def read(self, name, index=None):
        shape = self.view.height // self.view.samples, self.view.width // self.view.samples
        shape = shape if index is not None else (1, *shape)
        if name == "rgb":
            return np.full((*shape, 3), self.view.background, OUTPUTS[name].dtype)
        return np.zeros(shape, OUTPUTS[name].dtype)
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    (tmp_path / "fidsplat_toy.py").write_text(TOY)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(registry.FAMILIES, "toy", "fidsplat_toy")
    return fs.Renderer("toy")


def test_it_is_listed_and_renders(toy):
    assert "toy" in [info.name for info in registry.devices()]
    capture = fs.Capture(CAMERA, ("rgb", "alpha"), "fast,samples=2", (0.25, 0.5, 1.0))
    resident = toy.upload(CLOUD)
    frame = toy.render(resident, capture)
    assert frame["rgb"].shape == (4, 6, 3)
    assert (frame["rgb"] == np.float32([0.25, 0.5, 1.0])).all()
    assert (frame["alpha"] == 0).all()
    assert (frame.stats["splats"], resident.memory_bytes, len(resident)) == (1, 0, 1)
    assert [one["rgb"].shape for one in toy.render_views(CLOUD, [CAMERA, capture])] == [(4, 6, 3)] * 2


def test_a_missing_effect_is_an_error_that_names_both(toy):
    with pytest.raises(fs.DeviceError, match="toy has no depth"):
        toy.render(CLOUD, CAMERA, "depth")
    with pytest.raises(fs.InputError, match="device must wrap arrays, got toy"):
        toy.wrap_arrays(means=1, quats=1, scales=1, opacities=1, colors=1)
    with pytest.raises(fs.InputError, match="device must render subsets of pixels, got toy"):
        toy.render_subsampled(2, CLOUD, CAMERA)
    with pytest.raises(fs.DeviceError, match="device must have gradients, got toy"):
        toy.backend.gradient_pipeline(None)
    with pytest.raises(fs.InputError, match="a device that shares its arrays"):
        toy.render(CLOUD, CAMERA).device_array("rgb")
    with pytest.raises(fs.InputError, match="device must have a memory budget, got toy"):
        fs.Renderer("toy", memory_budget=1)
    assert not toy.backend.has("gradient_pipeline")
    assert not supports_float64(toy, fs.Capture(CAMERA))


def test_defaults_of_the_interface(toy):
    frame = toy.render(CLOUD, CAMERA)
    assert (frame.to_uint8() == 0).all()
    assert frame.wait().read_rows("rgb", 1, 2).shape == (4, 6, 3)
    batch = toy.render_batch(CLOUD, CAMERA, poses=[[0, 0, 0, 0, 0, 0, 1]] * 2, mask=[True, False])
    assert (batch["rgb"].shape, batch.stats["splats"]) == ((2, 4, 6, 3), 1)
    toy.backend.compile_in_background(None)
