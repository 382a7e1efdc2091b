"""Cases of group E: inputs, sizes, integers."""

import numpy as np
import pytest
from agreement import random_splats

import fidsplat as fs
from fidsplat.selftest import inputs
from fidsplat.selftest.agreement import COLOR_TOLERANCE, FrameSpec, reference_images, render


@pytest.mark.parametrize(("width", "height"), [(32767, 3), (3, 32767), (4001, 1003)])
def test_the_largest_grids_at_a_few_pixels(renderer, width, height):
    """Case E4: tens of thousands of tiles, compared with the reference in 200 pixels."""
    cloud = random_splats(60, seed=45, depth=(1.0, 4.0), scale=(0.01, 0.3))
    camera = inputs.sized(width, height)
    generator = np.random.default_rng(0)
    pixels = generator.integers(0, height, 200), generator.integers(0, width, 200)
    spec = FrameSpec(cloud, camera)
    expected, frame = reference_images(spec, pixels), render(renderer, spec)
    for name in ("rgb", "alpha"):
        error = np.abs(frame[name][pixels] - expected[name])
        error = error.max(-1) if error.ndim > 1 else error
        assert (error <= COLOR_TOLERANCE + expected["error_bound"]).all(), name


def opencl(renderer):
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("buffers of the OpenCL backend")
    return renderer.backend


@pytest.mark.parametrize("budget", [None, 40])
def test_list_offsets_wrap_at_2_to_the_32(renderer, monkeypatch, budget):
    """Case E3: a frame of more than 2^32 pairs has list offsets modulo 2^32. The offsets of a small one are
    increased until they wrap within its tiles.
    """
    from fidsplat.backends.opencl import probe, tiling

    backend = opencl(renderer)
    cloud = random_splats(60, seed=46, depth=(1.0, 4.0), scale=(0.05, 0.4))
    expected = renderer.render(cloud, inputs.VIEW, ("rgb", "depth"))
    stage = {"sort_first": "count_pairs", "bin_first": "compute_list_starts"}[backend.config.binning]
    original = getattr(tiling, stage)

    def moved(frame, *args):
        result = original(frame, *args)
        starts = frame.read("starts", np.uint32, (frame.tiles + 1,))
        starts += np.uint32(-(int(starts[-1]) // 2) % 2**32)
        frame.named["starts"] = probe.buffer_of(backend, starts)
        frame.named["cursors"] = probe.buffer_of(backend, starts[:-1])
        return result

    monkeypatch.setattr(tiling, stage, moved)
    monkeypatch.setattr(backend, "pair_budget", budget or backend.pair_budget)
    frame = renderer.render(cloud, inputs.VIEW, ("rgb", "depth"))
    assert all(np.array_equal(frame[name], expected[name]) for name in frame)


def test_a_buffer_above_the_device_limit_is_an_error_with_a_remedy(renderer):
    """Case E3: nothing beyond the device's limit is allocated, and the error has a remedy."""
    backend = opencl(renderer)
    limit = renderer.device.largest_allocation_bytes
    with pytest.raises(fs.DeviceError, match=r"lists must be at most .* use fewer splats or a smaller frame"):
        backend.pool.allocate("lists", limit + 1)


def test_all_buffers_are_poisoned(renderer):
    """Case E5 requires that all buffers are filled."""
    from fidsplat.backends.opencl import probe

    backend = opencl(renderer)
    measured = []
    with backend.probe().poisoned():
        filled = backend.pool._filled
        backend.pool._filled = lambda buffer: measured.append(buffer) or filled(buffer)
        renderer.render(random_splats(20, seed=1, depth=(1, 3)), inputs.VIEW, ("rgb", "depth"))
        again = probe.contents(backend, filled(backend.pool.scratch("splats", 64)))
    assert len(measured) > 15
    assert (again == 0xFF).all()
