"""OpenCL launches an image of a kind again, and renders a batch's views in parts: with the bits of images
that are rendered alone."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from agreement import random_splats
from test_memory import CAMERA, as_on_a_gpu, machines, own_device

import fidsplat as fs
from fidsplat.backends.opencl import memory_plan
from fidsplat.capture.views import capture_batch


@pytest.fixture(scope="module")
def opencl(renderer):
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("the OpenCL backend")
    return renderer


def test_kernels_see_new_buffers_at_old_addresses(opencl):
    """Arguments are cached between images, buffers are not: each cloud is rendered, not the previous one."""
    expected = [random_splats(50, seed=seed) for seed in range(6)]
    first = [opencl.render(cloud, CAMERA)["rgb"] for cloud in expected]
    for _ in range(3):
        for cloud, image in zip(expected, first, strict=True):
            assert np.array_equal(opencl.render(cloud, CAMERA)["rgb"], image)
    assert len({image.tobytes() for image in first}) == 6


def test_a_frame_is_replayed_for_each_view(opencl):
    """The same on a GPU: other poses, groups, colours and sizes are rendered in between, and frames are
    retained."""
    machine, renderer = as_on_a_gpu(opencl), as_on_a_gpu(opencl)
    some = (
        random_splats(300, seed=4)
        .with_labels(np.arange(300) % 2)
        .with_coplanar_groups(np.arange(300) // 250 - 1)
    )
    resident, places = machine.upload(some), (-0.3, 0.0, 0.2)
    moved = [np.eye(4) + 0.1 * k * np.eye(4, k=3) for k in range(3)]
    captures = [
        fs.Capture(
            fs.Camera.look_at(width, 40, 1.0, (x, 0.0, -0.1), (0.0, 0.0, 3.0)),
            ("rgb", "depth"),
            background=(0.1 * k, 0.2, 0.3),
            motion=fs.Motion(groups={1: lambda time, k=k: moved[k]}),
        )
        for width in (50, 60)
        for k, x in enumerate(places)
    ]
    first_frame = [machine.render(resident, capture) for _ in range(3) for capture in captures]
    assert [each.generation is not None for each in resident.data.cached_frames.values()] == [True, True]
    for frame, capture in zip(first_frame, captures * 3, strict=True):
        expected = renderer.render(some, capture)
        assert all(np.array_equal(frame[name], expected[name]) for name in frame)
        assert frame.stats == expected.stats
        assert set(frame.timings) == {"project", "sort", "bin", "blend"}  # which resolves
    assert first_frame[-1].wait() is first_frame[-1]


def test_counts_of_another_kind_of_frame_are_ignored(opencl):
    """One that is rendered for the first time, into buffers that are there, leaves its counters to whom comes
    next: an image that is launched again."""
    machine = as_on_a_gpu(opencl)
    resident = machine.upload(random_splats(300, seed=4))
    first, *_ = (machine.render(resident, CAMERA)["rgb"] for _ in range(3))
    (frame,) = resident.data.cached_frames.values()
    launches, state = frame.commands._commands, machine.backend.pool.generation
    machine.render(resident, fs.Camera.look_at(50, 40, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0)))
    assert np.array_equal(machine.render(resident, CAMERA)["rgb"], first)
    assert frame.commands._commands is launches, "replayed"
    assert machine.backend.pool.generation is state


def test_a_replay_on_a_cpu_enlarges_its_lists(opencl):
    """A camera that approaches splats: each frame is rendered once, with the pairs that it has."""
    if opencl.device.kind != "cpu":
        pytest.skip("the host waits for the counts on CPUs only")
    machine, renderer = fs.Renderer(opencl.device.name), fs.Renderer(opencl.device.name)
    some = random_splats(2000, seed=4, scale=(1e-2, 0.1), depth=(2.0, 6.0))
    places = np.linspace(-30, 1, 9)
    cameras = [fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, z), (0.0, 0.0, 30.0)) for z in places]
    resident, begun = machine.upload(some), machine.backend.frames
    frames = [machine.render(resident, camera) for camera in cameras]
    assert machine.backend.frames - begun == len(cameras)
    (cached,) = resident.data.cached_frames.values()
    assert cached.generation is machine.backend.pool.generation
    assert cached.capacity.pairs > 1.2 * frames[0].stats["pairs"], "lists were enlarged"
    for frame, camera in zip(frames, cameras, strict=True):
        expected = renderer.render(some, camera)
        assert np.array_equal(frame["rgb"], expected["rgb"])
        assert frame.stats == expected.stats


def test_a_frame_in_ranges_of_tiles_is_not_replayed(opencl):
    """Its lists exceed the pair budget, so a replay would project and count the splats for nothing."""
    machine, some = fs.Renderer(opencl.device.name), random_splats(2000, seed=4)
    expected = machine.render(some, CAMERA)
    backend = machine.backend
    backend.pair_budget = expected.stats["pairs"] // 3
    resident, begun = machine.upload(some), backend.frames
    frames = [machine.render(resident, CAMERA) for _ in range(4)]
    assert all(np.array_equal(frame["rgb"], expected["rgb"]) for frame in frames)
    assert backend.frames - begun == len(frames)
    assert not resident.data.cached_frames


@pytest.mark.parametrize("scale", [(1e-2, 0.3), (2.0, 3.0)], ids=["pairs", "big splats"])
def test_a_frame_that_exceeds_the_last_is_rendered_again(opencl, scale):
    """More pairs, or more splats of many tiles, than there is room for: found when the frame is read."""
    machine, renderer = as_on_a_gpu(opencl), fs.Renderer(opencl.device.name)
    some = random_splats(6000, seed=4, scale=scale, depth=(2.0, 6.0))
    places = (-900, -800, 0, 1, -700)
    cameras = [fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, z), (0.0, 0.0, 30.0)) for z in places]
    resident = machine.upload(some)
    frames = [machine.render(resident, camera) for camera in cameras]
    pairs = [frame.stats["pairs"] for frame in frames]
    assert max(pairs) > 1.5 * pairs[1], "it did outgrow it"
    for frame, camera in zip(frames, cameras, strict=True):
        assert np.array_equal(frame["rgb"], renderer.render(some, camera)["rgb"])


def test_threads_share_cached_launches(opencl):
    """Sixteen draw images of two kinds with a GPU's kernels, of a cloud that outgrows its room at times,
    and read them, their times and their counts while others draw."""
    machine, renderer = as_on_a_gpu(opencl), as_on_a_gpu(opencl)
    some = random_splats(500, seed=4, scale=(1e-2, 0.3), depth=(2.0, 6.0))
    captures = [
        fs.Capture(fs.Camera.look_at(width, 40, 1.0, (0.0, 0.0, z), (0.0, 0.0, 30.0)))
        for width in (50, 60)
        for z in (-900, 0, 1)
    ]
    expected = [renderer.render(some, capture) for capture in captures]
    resident = machine.upload(some)

    def draw(number):
        frames = [machine.render(resident, captures[(number + k) % 6]) for k in range(6)]
        return all(
            np.array_equal(frame["rgb"], expected[(number + k) % 6]["rgb"])
            and frame.stats == expected[(number + k) % 6].stats
            and len(frame.timings) == 4
            for k, frame in enumerate(frames)
        )

    with ThreadPoolExecutor(16) as pool:
        assert all(pool.map(draw, range(32)))


@machines
def test_a_batch_in_parts_has_the_bits_of_its_views(opencl, monkeypatch, machine):
    """Several views at a time, with planes, groups that move, a mask, and images of other kinds between."""
    renderer, some = (
        machine(opencl),
        random_splats(300, seed=4, scale=(1e-2, 2.0)).with_labels(np.arange(300) % 3),
    )
    some = some.with_coplanar_groups(np.arange(300) // 250 - 1)
    capture = fs.Capture(fs.Camera.look_at(50, 40, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0)), ("rgb", "label"))
    poses = np.random.default_rng(0).normal(0, 0.05, (2, 7, 7))
    poses[..., 3] += 1
    requested = {"poses": poses[0], "groups": {2: poses[1]}, "mask": np.arange(7) != 3}
    resident = renderer.upload(some)
    for most in (1 << 31, 1 << 18):
        monkeypatch.setattr(memory_plan, "SUB_BATCH_BYTES", {})
        monkeypatch.setattr(memory_plan, "OTHER_SUB_BATCH_BYTES", most)
        rendered = renderer.render_batch(resident, capture, **requested)
        alone = renderer.render(resident, capture)
        for number in (0, 1, 2, 4, 5, 6):
            one = {"poses": poses[0, [number]], "groups": {2: poses[1, [number]]}}
            expected = opencl.render(some, capture_batch([capture], **one).capture(0))
            assert all(np.array_equal(rendered[name][number], expected[name]) for name in rendered), (
                most,
                number,
            )
        assert (rendered["label"][3] == -1).all()
        assert not rendered["rgb"][3].any()
        assert np.array_equal(rendered.device_array("rgb").get(), rendered["rgb"])
        assert np.array_equal(alone["rgb"], opencl.render(some, capture)["rgb"])


def test_a_batch_whose_images_are_too_many_is_an_error(opencl):
    renderer, poses = own_device(opencl, 2**23), np.tile([0, 0, 0, 1, 0, 0, 0.0], (400, 1))
    with pytest.raises(fs.DeviceError, match=r"images of 400 views must be .* render fewer views"):
        renderer.render_batch(random_splats(10, seed=1), CAMERA, poses=poses)


SIDES = [(40, 30), (40, 50), (60, 30), (60, 50)]


@pytest.mark.parametrize("number", [1, 2])
def test_sizes_that_share_a_side_have_frames_of_their_own(renderer, number):
    """Repeatedly, so that commands of each size are replayed between those of the others."""
    cloud = random_splats(300, seed=4)
    cameras = [fs.Camera.look_at(*size, 1.0, (0, 0, -0.1), (0, 0, 3)) for size in SIDES]
    expected = [renderer.render(cloud, camera)["rgb"] for camera in cameras]
    resident = renderer.upload(cloud)
    for _ in range(4):
        for camera, image in zip(cameras, expected, strict=True):
            batch = renderer.render_batch(resident, [fs.Capture(camera)] * number)
            assert all(np.array_equal(each, image) for each in batch["rgb"])
            assert np.array_equal(renderer.render(resident, camera)["rgb"], image)
