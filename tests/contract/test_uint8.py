"""`Frame.to_uint8`: 8 bits made on the device, bit for bit those of `to_uint8` on the host."""

import pickle

import numpy as np
import pytest
from agreement import random_splats

import fidsplat as fs
from fidsplat.backends.opencl.kernel_config import gpu_config
from fidsplat.images.files import to_uint8
from fidsplat.util.errors import MissingOutputError

CLOUD = random_splats(60, seed=2)
STEPS = np.arange(256, dtype=np.float32)
HALVES = (STEPS[:-1] + np.float32(0.5)) / np.float32(255)
KINDS = np.concatenate(
    [
        np.array([np.nan, np.inf, -np.inf, -0.0, 1e-45, -1e-45, -3.0, 1.5, 3e38, 1.0], np.float32),
        STEPS / np.float32(255),
        *(np.nextafter(HALVES, np.float32(towards)) for towards in (0.0, 2.0)),
        HALVES,
    ]
)
"""values at which a conversion may go wrong: no numbers, beyond both ends, on and beside every half"""


def rendered(renderer, width, height):
    camera = fs.Camera.look_at(width, height, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
    return renderer.render(CLOUD, camera, background=(-0.25, 0.5, 1.75))


def put(frame, values):
    """Replaces the values that the device has rendered."""
    images = frame.wait()._images
    if hasattr(images, "arrays"):
        images.arrays["rgb"].assign(values.ravel())
    else:
        cl = pytest.importorskip("pyopencl")
        cl.enqueue_copy(images._workspace.queue, images.buffer("rgb"), values)


@pytest.mark.parametrize("size", [(37, 23), (64, 32)], ids=str)
def test_an_image_equals_the_hosts_bit_for_bit(renderer, size):
    frame = rendered(renderer, *size)
    assert frame._images.read_uint8("rgb") is not None
    on_device = frame.to_uint8()
    assert (on_device.shape, on_device.dtype) == ((*size[::-1], 3), np.uint8)
    assert np.array_equal(on_device, to_uint8(frame["rgb"]))
    assert np.array_equal(frame.to_uint8(), on_device)  # of what was read
    assert {0, 255} < set(on_device.ravel())


@pytest.mark.parametrize("size", [(1, 1), (5, 1), (16, 1), (37, 23)], ids=str)
def test_every_kind_of_value(renderer, size):
    """Also in the last values, which fill no work-item."""
    for shift in (0, 7):
        frame = rendered(renderer, *size)
        values = np.resize(np.roll(KINDS, shift), (size[1], size[0], 3))
        put(frame, values)
        assert np.array_equal(frame.to_uint8(), to_uint8(values))


def test_every_kind_of_value_by_a_gpus_work_items(renderer):
    """On any device; each work-item converts four values, not sixteen."""
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("the OpenCL backend")
    frame = rendered(fs.Renderer(renderer.device.name), 37, 23)
    frame.wait()._images._workspace.config = gpu_config()
    values = np.resize(KINDS, (23, 37, 3))
    put(frame, values)
    assert np.array_equal(frame.to_uint8(), to_uint8(values))


def test_frames_are_read_concurrently(renderer):
    """Each keeps its own, though the device's buffer is used again."""
    frames = [rendered(renderer, 37, 23), rendered(renderer, 23, 37)]
    read = [frame.to_uint8() for frame in (*frames, *frames)]
    for frame, first, again in zip(frames, read[:2], read[2:], strict=True):
        assert np.array_equal(first, again)
        assert np.array_equal(first, to_uint8(frame["rgb"]))


def test_frames_of_a_batch_are_converted_on_the_device(renderer):
    """Their images begin at bytes that no vector of the device is aligned to."""
    cameras = [fs.Camera.look_at(37, 23, 1.0, (x, 0.0, -0.1), (0.0, 0.0, 3.0)) for x in (-0.4, 0.0, 0.3)]
    batch = renderer.render_batch(CLOUD, [fs.Capture(camera) for camera in cameras])
    images = [batch.frame(k).to_uint8() for k in range(3)]
    assert all(batch._images.read_uint8("rgb", k) is not None for k in range(3))
    for image, expected in zip(images, batch["rgb"], strict=True):
        assert np.array_equal(image, to_uint8(expected))
    assert len({image.tobytes() for image in images}) == 3


def test_the_reference_and_cached_frames_convert_on_the_host(reference):
    frame = rendered(reference, 9, 7)
    expected = to_uint8(frame["rgb"])
    assert np.array_equal(frame.to_uint8(), expected)
    assert np.array_equal(pickle.loads(pickle.dumps(frame)).to_uint8(), expected)


def test_a_frame_without_rgb_says_so(reference):
    camera = fs.Camera.look_at(9, 7, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
    with pytest.raises(MissingOutputError, match="got 'rgb'"):
        reference.render(CLOUD, camera, outputs="depth").to_uint8()
