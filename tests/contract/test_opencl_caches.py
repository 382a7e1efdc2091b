"""Caches of the OpenCL backend from frame to frame, and their release: images, views, lenses, times."""

import gc
import weakref

import numpy as np
import pyopencl as cl
import pytest
from agreement import random_splats
from test_memory import CAMERA, as_on_a_gpu, own_device

import fidsplat as fs


@pytest.fixture(scope="module")
def opencl(renderer):
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("the OpenCL backend")
    return renderer


def test_a_part_of_a_batch_on_the_device_keeps_its_images(opencl):
    """The next batch is rendered into other buffers while a view of the last is held, though nothing else
    is."""
    renderer, some = own_device(opencl), random_splats(100, seed=7)
    poses = np.tile([0, 0, 0, 1, 0, 0, 0.0], (2, 1))
    first = renderer.render_batch(some, CAMERA, poses=poses).wait()
    expected = first["rgb"][1]
    view = first.device_array("rgb")[1]
    del first
    others = [renderer.render_batch(some, CAMERA, poses=poses + k * np.eye(7)[2]).wait() for k in (1, 2, 3)]
    assert not np.array_equal(others[0]["rgb"][1], expected)
    assert np.array_equal(view.get(), expected)
    held = weakref.ref(others[-1]._images)
    del others
    assert held() is None, "nor is a batch kept for ever"


class LessAtOnce:
    """A device with a small maximum size of one allocation."""

    def __init__(self, device, largest):
        self._device, self.max_mem_alloc_size = device, largest

    def __getattr__(self, name):
        return getattr(self._device, name)


def test_a_batch_is_cut_where_no_buffer_holds_all_its_splats(opencl):
    renderer, some = as_on_a_gpu(opencl), random_splats(2000, seed=4, scale=(1e-2, 0.1))
    poses = np.tile([0, 0, 0, 1, 0, 0, 0.0], (8, 1))
    camera = fs.Camera.look_at(50, 40, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
    full_batch = renderer.render_batch(some, camera, poses=poses)["rgb"]
    renderer.backend.release_scratch()
    device = LessAtOnce(renderer.backend.device, 1 << 19)
    renderer.backend.device = renderer.backend.pool._device = device
    renderer.backend.limit_memory(renderer.backend.memory_budget)
    assert np.array_equal(renderer.render_batch(some, camera, poses=poses)["rgb"], full_batch)
    with pytest.raises(fs.DeviceError, match=r"rgb of 40 views must be at most .* render fewer views"):
        renderer.render_batch(some, camera, poses=np.tile(poses, (5, 1)))


def test_cached_views_do_not_retain_their_surroundings(opencl):
    """Each view has its own panorama; its arrays are released with its capture."""
    machine, rng = as_on_a_gpu(opencl), np.random.default_rng(1)
    resident, known = machine.upload(random_splats(20, seed=1)), []
    for _ in range(12):
        around = fs.Panorama(rng.random((20, 40, 3)))
        known.append(weakref.ref(around))
        machine.render(resident, CAMERA, background=around).wait()
    del around
    gc.collect()
    assert sum(one() is not None for one in known) <= 2


def test_lenses_that_come_and_go_leave_no_rays_on_the_device(opencl):
    """A zoom: each image has its own rays."""
    machine = as_on_a_gpu(opencl)
    resident = machine.upload(random_splats(20, seed=1))
    for k in range(10):
        machine.render(resident, fs.Camera.fisheye(40, 30, 2.0 + 0.1 * k)).wait()
    gc.collect()
    assert len(machine.backend.ray_buffers._buffers) <= 5


class Lost:
    """A queue of a device that is gone."""

    def finish(self):
        raise cl.RuntimeError("clFinish failed: OUT_OF_RESOURCES")


def test_a_device_that_fails_is_one_sentence_wherever_it_is_noticed(opencl):
    frame = opencl.render(random_splats(10, seed=8), CAMERA)
    frame._images._rendered[0].queue = Lost()
    with pytest.raises(fs.DeviceError, match="failed while rendering"):
        frame.wait()
    with pytest.raises(fs.DeviceError, match="failed while rendering"):
        dict(frame.timings)


def test_times_of_a_frame_are_taken_once(opencl):
    machine = as_on_a_gpu(opencl)
    resident = machine.upload(random_splats(20, seed=1))
    frame = [machine.render(resident, CAMERA) for _ in range(3)][-1]
    assert frame.timings == frame.timings
    images = machine.backend.frames
    assert frame.timings
    assert machine.backend.frames == images
