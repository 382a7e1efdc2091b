"""Images of GPUs on the host: page-locked memory, reused when no array refers to it."""

import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.opencl import host_memory
from fidsplat.scenes.random_clouds import random_splats


@pytest.fixture
def renderer(monkeypatch):
    monkeypatch.setattr(host_memory, "_MINIMUM", 1)
    renderer = fs.Renderer("opencl")
    memory = renderer.backend.host_memory
    monkeypatch.setattr(memory, "pins_memory", True)  # as GPUs do
    return renderer


def addresses(frames):
    return [frame["rgb"].ctypes.data for frame in frames]


def test_retained_images_retain_their_memory(renderer):
    cloud = random_splats(50, 1)
    cameras = [fs.Camera.look_at(64, 48, 1.0, (0.05 * k, 0, -1), (0, 0, 2)) for k in range(6)]
    there, plain = renderer.upload(cloud), fs.Renderer("opencl")
    frames = list(renderer.render_views(there, cameras))
    assert len(set(addresses(frames))) == len(frames)
    for frame, camera in zip(frames, cameras, strict=True):
        assert np.array_equal(frame["rgb"], plain.render(cloud, camera)["rgb"])
    parts = [frame["rgb"][3:5, 7:9] for frame in frames]
    before, held = [part.copy() for part in parts], addresses(frames)
    del frames, frame
    again = [renderer.render(there, camera) for camera in reversed(cameras)]
    assert not set(addresses(again)) & set(held)  # parts of images hold them
    assert all(np.array_equal(part, copy) for part, copy in zip(parts, before, strict=True))
    del parts
    last = [renderer.render(there, camera) for camera in cameras]
    assert set(addresses(last)) & set(held)


def test_images_of_about_the_same_size_take_the_same_memory(renderer):
    memory = renderer.backend.host_memory
    memory.empty((100, 100), np.float32)  # the first is in ordinary memory
    places = set()
    for columns in (100, 98, 101, 97, 102):
        array = memory.empty((100, columns), np.float32)
        array[:] = columns
        assert array.base is not None
        places.add(array.ctypes.data)
        del array
    assert len(places) == 1
    assert memory._pinned < 1.25 * 4 * 100 * 102


def test_no_more_is_locked_than_allowed(renderer, monkeypatch):
    memory, shape = renderer.backend.host_memory, (10, 10)
    monkeypatch.setattr(host_memory, "_MAXIMUM", 900)
    first = memory.empty(shape, np.float32)
    assert first.base is None  # the first of a size is in ordinary memory
    arrays = [memory.empty(shape, np.float32) for _ in range(4)]
    assert [array.base is not None for array in arrays] == [True, True, False, False]
    assert all(
        array.shape == shape and array.dtype == np.float32 and array.flags.writeable for array in arrays
    )
    del arrays
    assert memory.empty((9, 9), np.int32).base is None
    other = memory.empty((9, 9), np.int32)  # what lies idle makes room
    assert other.base is not None
    assert memory._pinned <= 900
    assert math.prod(other.shape) == 81
