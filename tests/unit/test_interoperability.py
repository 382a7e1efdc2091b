"""Frames, clouds and scenes in notebooks and with other array libraries."""

import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.interface import Images
from fidsplat.images.files import to_uint8
from fidsplat.scenes import PlacedMarker

CAMERA = fs.Camera.look_at(24, 16, 1.0, (0, 0, -1), (0, 0, 0))
TAG = fs.marker("aruco:4x4_50:7", size=0.4)
SCENE = fs.Scene(markers=[PlacedMarker(TAG)], camera=CAMERA)


def frame(*outputs) -> fs.Frame:
    return fs.Renderer("reference").render(SCENE, outputs=outputs)


def decoded(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]


def test_a_frame_shows_itself():
    both = frame("depth", "rgb")
    np.testing.assert_array_equal(decoded(both._repr_png_()), to_uint8(both["rgb"]))
    assert repr(both).startswith("Frame(depth, rgb, ")
    deep = decoded(frame("depth")._repr_png_())
    assert deep[8, 12].any()  # in colours, as there is no rgb
    assert not deep[0, 0].any()


class Shared(Images):
    """Images of a device whose arrays others can use."""

    shares_arrays = True
    timings, stats = {}, {}

    def __init__(self, arrays):
        self.arrays = arrays

    def read(self, name, index=None):
        return np.asarray(self.arrays[name])

    def device_array(self, name, index=None):
        return self.arrays[name]


def test_a_frame_of_one_output_is_an_array():
    one = frame("rgb")
    np.testing.assert_array_equal(np.asarray(one), one["rgb"])
    assert np.asarray(one, np.float64).dtype == np.float64
    assert np.array(one).flags.writeable  # a copy
    assert np.shares_memory(one.__array__(copy=False), one["rgb"])
    with pytest.raises(ValueError, match="dtype must be float32 with copy=False, got float64"):
        one.__array__(np.dtype(np.float64), copy=False)
    assert cv2.cvtColor(np.asarray(one), cv2.COLOR_RGB2GRAY).shape == (16, 24)
    with pytest.raises(
        fs.InputError, match=r"must have one output, got 2 \(rgb, depth\); access one by its name"
    ):
        np.asarray(frame("rgb", "depth"))


def test_a_frame_becomes_a_tensor(monkeypatch):
    """Without a copy by DLPack if the backend shares arrays; else a writable copy."""
    torch = SimpleNamespace(from_dlpack=lambda array: ("dlpack", array), from_numpy=lambda a: ("numpy", a))
    monkeypatch.setitem(sys.modules, "torch", torch)
    rendered = frame("rgb", "label")
    kind, array = rendered.to_torch("label")
    assert kind == "numpy"
    assert array.flags.writeable
    np.testing.assert_array_equal(array, rendered["label"])
    assert fs.Frame(Shared({"rgb": "rgb there"}), fs.Capture(outputs="rgb")).to_torch() == (
        "dlpack",
        "rgb there",
    )
    with pytest.raises(fs.InputError, match="got 'depth'"):
        rendered.to_torch("depth")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(fs.InputError, match=r"torch must be installed .*; pip install torch"):
        rendered.to_torch()


def test_torch_itself_takes_a_frame():
    torch = pytest.importorskip("torch", reason="torch is not installed")
    rendered = frame("rgb")
    assert torch.equal(rendered.to_torch(), torch.tensor(rendered["rgb"]))
    assert torch.equal(torch.from_dlpack(rendered), torch.tensor(rendered["rgb"]))


def test_a_frame_of_one_output_goes_through_dlpack():
    one = frame("label")
    there = np.from_dlpack(one)
    np.testing.assert_array_equal(there, one["label"])
    assert not np.shares_memory(there, one["label"])
    given = np.arange(6.0).reshape(2, 3)
    shared = fs.Frame(Shared({"depth": given}), fs.Capture(outputs="depth"))
    assert np.shares_memory(np.from_dlpack(shared), given)  # no copy
    with pytest.raises(fs.InputError, match="must have one output, got 2"):
        np.from_dlpack(frame("rgb", "depth"))


def test_pil_and_opencv_take_a_frame():
    """As docs/rendering.md says."""
    rendered = frame("rgb")
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    np.testing.assert_array_equal(
        np.asarray(image.fromarray(to_uint8(rendered["rgb"]))), to_uint8(rendered["rgb"])
    )
    bgr = cv2.cvtColor(to_uint8(rendered["rgb"]), cv2.COLOR_RGB2BGR)
    np.testing.assert_array_equal(bgr[:, :, ::-1], to_uint8(rendered["rgb"]))


def test_clouds_and_scenes_say_what_they_hold():
    cloud = fs.SplatCloud(
        [[0, 0, 0], [1, 2, 3]], [[1, 0, 0, 0]] * 2, [[0.1, 0.1, 0.0], [0.1, 0.1, 0.2]], [1, 1],
        sh=np.zeros((2, 4, 3)), labels=[0, 5],
    )  # fmt: skip
    summary = cloud.summary()
    assert summary["splats"] == "2, 2D and 3D"
    assert summary["colours"] == "SH of degree 1"
    assert summary["labels"] == "2 different"
    assert summary["bounds"].endswith(" m")
    assert "<td style='text-align:left'>2, 2D and 3D</td>" in cloud._repr_html_()
    assert fs.SplatCloud.empty().summary() == {"splats": "0, 2D", "colours": "plain"}
    scene = fs.Scene([cloud], camera=CAMERA, markers=[PlacedMarker(fs.marker("qr:<b>", size=0.1))])
    assert repr(scene) == "Scene(2 splats, qr:<b>)"
    assert scene.summary()["marker 1"] == "qr:<b>, 0.1 m at (0, 0, 0)"
    assert scene.summary()["camera"] == "24 x 16, pinhole, at (0, 0, -1)"
    assert "qr:&lt;b&gt;" in scene._repr_html_()
    assert "<b>Scene</b>" in scene._repr_html_()


def test_renderers_and_batches_name_what_they_hold():
    renderer = fs.Renderer("reference")
    assert repr(renderer) == f"Renderer('reference', {renderer.device.title})"
    camera = fs.Camera.look_at(4, 3, 1.0, (0, 0, -1), (0, 0, 0))
    batch = renderer.render_batch(fs.SplatCloud.empty(), 2 * [fs.Capture(camera, ("rgb", "depth"))])
    assert repr(batch) == "FrameBatch(2 views, rgb, depth, 4 x 3)"
    assert repr(fs.SeveralDevices(["reference"])) == "SeveralDevices(reference)"
