"""A memory budget changes how an image is rendered, never its values."""

import sys
import weakref
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from agreement import ALL_OUTPUTS, random_splats, some_thick
from sampling import alternate

import fidsplat as fs
from fidsplat.backends.opencl import tiling
from fidsplat.backends.opencl.kernel_config import gpu_config
from fidsplat.backends.opencl.memory_plan import plan_of
from fidsplat.backends.ranges import split_by_cost

UNTOUCHED = 0xFFFFFFFF
CAMERA = fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))


@pytest.fixture(scope="module")
def opencl(renderer):
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("memory of the OpenCL backend")
    return renderer


def small(renderer, mebibytes, cloud=None):
    """The same device with little memory in addition to that of the cloud, which it does not read from
    the host."""
    budget = round(mebibytes * 2**20)
    if renderer.device.kind != "cpu":
        budget += 2 << 20  # tables of the ordered lists, which have many pieces there, and more for pairs
    if cloud is not None and renderer.device.kind != "cpu":
        arrays = (
            cloud.means,
            cloud.quats,
            cloud.scales,
            cloud.opacities,
            cloud.colors,
            cloud.sh,
            cloud.coplanar_groups,
            cloud.thickness,
        )
        budget += sum(array.nbytes for array in arrays if array is not None)
    return fs.Renderer(renderer.device.name, memory_budget=budget)


def own_device(renderer, budget=None):
    return fs.Renderer(renderer.device.name, memory_budget=budget)


def roomy(renderer):
    """The same device with enough memory, but a limit, so that small frames have large tiles too."""
    return own_device(renderer, 2**30)


def as_on_a_gpu(renderer, budget=None):
    """The kernels and tables of a GPU, and a cloud that is copied, on whatever device this is."""
    limited_renderer = fs.Renderer(renderer.device.name)
    backend = limited_renderer.backend
    backend.info = replace(backend.info, kind="gpu")
    backend.config = gpu_config(256, backend.config.fast_fma)
    backend.limit_memory(budget or backend.memory_budget)
    return limited_renderer


MACHINES = {"own": own_device, "gpu": as_on_a_gpu}
machines = pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES)


@pytest.fixture(scope="module")
def cloud():
    """200 disks of a plane; of the others every third is a 3D Gaussian."""
    splats = random_splats(30000, 1, scale=(1e-3, 0.5), sh_degree=2)
    number = np.arange(len(splats))
    third = np.where((number >= 200) & (number % 3 == 0), 0.05, 0)
    splats = some_thick(splats, third)
    return splats.with_coplanar_groups(np.where(number < 200, 0, -1))


def test_one_pair_more_than_the_budget_makes_a_second_band(opencl, cloud, whole, monkeypatch):
    """Lists are never longer than the memory that is planned for them."""
    images, stats = whole
    budget = stats["pairs"] - 1
    bands, limited = [], roomy(opencl)

    def noted(*requested):
        bands.extend(split_by_cost(*requested))
        return bands

    monkeypatch.setattr(limited.backend, "pair_budget", budget)
    monkeypatch.setattr("fidsplat.backends.opencl.tiling.split_by_cost", noted)
    frame = limited.render(cloud, CAMERA, ALL_OUTPUTS)
    assert len(bands) == 2
    assert max(pairs for _, _, pairs in bands) <= budget
    assert all(np.array_equal(frame[name], image) for name, image in images.items())


@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("scale", [(0.05, 0.1), (1.0, 2.0)], ids=["windows", "big"])
@machines
def test_nothing_is_written_beyond_the_capacity_of_lists(opencl, monkeypatch, machine, scale, views):
    """Neither where they just fit nor, on a GPU, where there are more pairs than there is room for: of splats
    that touch few tiles, and of big ones, whose pairs are written elsewhere, as those of many views are."""
    renderer, some = machine(opencl), random_splats(300, seed=4, scale=scale)

    def rendered():
        return renderer.render(some, CAMERA) if views == 1 else renderer.render_batch(some, [CAMERA] * views)

    expected = rendered()
    pairs, pool, queue = expected.stats["pairs"], renderer.backend.pool, renderer.backend.queue
    words = {"lists": pairs}
    if machine is as_on_a_gpu:
        words, capacity, split = {"pairs": 200, "lists": 100}, tiling.pair_capacity, tiling.tile_ranges

        def first_looked_at(*given):
            look()
            monkeypatch.setattr(tiling, "pair_capacity", capacity)
            return split(*given)

        monkeypatch.setattr(tiling, "pair_capacity", lambda workspace, config: 100)
        monkeypatch.setattr(tiling, "tile_ranges", first_looked_at)
    collected = []

    def look():
        for name, first in words.items():
            rest = np.empty(pool.size(name) // 4 - first, np.uint32)
            cl.enqueue_copy(queue, rest, pool._buffers[name], src_offset=4 * first)
            collected.append((rest == UNTOUCHED).all())

    for name in words:
        buffer = pool.scratch(name, max(pool.size(name), 4 * pairs + 64))
        cl.enqueue_fill_buffer(queue, buffer, np.uint32([UNTOUCHED]), 0, buffer.size)
    frame = rendered()
    assert np.array_equal(frame["rgb"], expected["rgb"])
    if machine is own_device:
        look()
    assert collected == [True] * len(words)


@pytest.fixture(scope="module")
def whole(opencl, cloud):
    frame = roomy(opencl).render(cloud, CAMERA, ALL_OUTPUTS)
    return {name: frame[name] for name in frame}, dict(frame.stats)


@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("mebibytes", [3.7, 4, 4.5])
@pytest.mark.parametrize("streamed", [False, True])
def test_little_memory_gives_the_same_bits(opencl, cloud, whole, mebibytes, streamed):
    """Slices of the cloud, bands of rows, and a cloud that is copied in slices or stays where it is. With a
    printed plane among them, so every fragment by its own depth."""
    renderer = small(opencl, mebibytes, None if streamed else cloud)
    resident = renderer.upload(cloud)
    resident.data._shared &= not streamed  # a CPU reads the host's arrays; make it copy them
    resident.data.streamed = streamed
    for _ in range(2):
        frame = renderer.render(resident, CAMERA, ALL_OUTPUTS)
        assert frame.stats == whole[1]
        for name in ALL_OUTPUTS:
            assert np.array_equal(frame[name], whole[0][name]), name
    assert "packed splats" in renderer.backend.pool._buffers, "it was drawn in slices"


def test_many_big_splats_in_slices(opencl):
    """More splats that touch many tiles than the first guess has room for."""
    crowd = random_splats(26000, seed=2, depth=(-19.0, 9.0), scale=(0.5, 3.0))
    expected = roomy(opencl).render(crowd, CAMERA, ("rgb", "depth"))
    renderer = small(opencl, 3.2)
    resident = renderer.upload(crowd)
    resident.data._shared, resident.data.streamed = False, True
    frame = renderer.render(resident, CAMERA, ("rgb", "depth"))
    assert "packed splats" in renderer.backend.pool._buffers
    assert frame.stats == expected.stats
    assert all(np.array_equal(frame[name], expected[name]) for name in frame)


@pytest.mark.parametrize(("budget", "words"), [(2**20, "1 MiB"), (200_000, "195 KiB")])
def test_a_budget_below_the_image_is_an_error_with_a_remedy(opencl, cloud, budget, words):
    with pytest.raises(fs.DeviceError, match=rf"memory_budget must exceed .*, got {words}; raise it"):
        own_device(opencl, budget).render(cloud, CAMERA, ALL_OUTPUTS)


def test_a_row_of_tiles_with_too_many_splats_is_an_error(opencl):
    crowd = random_splats(40000, seed=3, depth=(2.0, 3.0), scale=(1e-3, 1e-2), across=0.01)
    with pytest.raises(fs.DeviceError, match=r"splats of a row of tiles must be .* raise memory_budget"):
        small(opencl, 2).render(crowd, CAMERA)


@pytest.mark.parametrize("budget", [0, -1, 1.5e9, "2 GiB", True])
def test_odd_budgets_are_refused(opencl, budget):
    with pytest.raises(fs.InputError, match=r"memory_budget must be a positive whole number of bytes, got"):
        fs.Renderer(opencl.device.name, memory_budget=budget)


def test_the_reference_has_no_budget():
    with pytest.raises(fs.InputError, match="must have a memory budget, got reference"):
        fs.Renderer("reference", memory_budget=2**30)


def test_plans_hold_to_the_budget():
    for count in (10**5, 2 * 10**7, 10**8):
        for budget in (2**28, 2**30, 2**34):
            for upload in (0, 52):
                plan = plan_of(count, 80, upload, 2**27, "sort_first", budget, budget // 4)
                held = (
                    plan.max_visible * (80 + 12 + 16)
                    + plan.slice_size * (80 + 12 + upload)
                    + budget // 8
                    + 2**27
                )
                assert held == plan.total or not plan.slice_size
                assert plan.total <= budget, (count, budget, upload, plan)
                assert plan.max_visible * 80 <= budget // 4
                assert plan.slice_size or (plan.max_visible == count and not upload)


def test_views_are_rendered_like_single_frames(renderer):
    """Renderer.render_views: one upload, images in the order of the cameras."""
    some = random_splats(300, seed=4)
    cameras = [fs.Camera.look_at(40, 30, 1.0, (x, 0.0, -0.1), (0.0, 0.0, 3.0)) for x in (-0.5, 0.0, 0.5)]
    frames = list(renderer.render_views(some, cameras, ("rgb", "depth")))
    assert len(frames) == 3
    for frame, camera in zip(frames, cameras, strict=True):
        single = renderer.render(some, camera, ("rgb", "depth"))
        assert all(np.array_equal(frame[name], single[name]) for name in frame)
    assert list(renderer.render_views(some, [])) == []


def test_frames_of_many_sizes_leave_no_heap_of_buffers(opencl):
    """Image buffers return to the pool when their frame is deleted; buffers of another size are released."""
    some = random_splats(50, seed=5)
    renderer = fs.Renderer(opencl.device.name)
    held = []
    for width in (64, 32, 48, 64, 16, 64):
        frames = [
            renderer.render(some, fs.Camera.look_at(width, 32, 1.0, (0, 0, -0.1), (0, 0, 3)))
            for _ in range(4)
        ]
        assert frames[0]["rgb"].shape == (32, width, 3)
        del frames
        renderer.render(some, fs.Camera.look_at(64, 32, 1.0, (0, 0, -0.1), (0, 0, 3)))
        held.append(renderer.backend.pool.memory_bytes)
    assert max(held) <= held[0]


@machines
def test_a_pool_keeps_to_the_budget_whatever_was_rendered_before(opencl, machine):
    """Images at once and in slices, few and many outputs: buffers of one kind do not count against the
    budget of the next."""
    budget = 8 * 2**20
    renderer, opencl = machine(opencl, budget), machine(opencl)
    for count, outputs in ((35000, ("rgb",)), (200000, ALL_OUTPUTS), (50000, ("rgb",)), (200000, ("rgb",))):
        crowd = random_splats(count, seed=6, scale=(1e-4, 1e-2))
        resident = renderer.upload(crowd)
        expected = opencl.render(crowd, CAMERA, outputs)
        frame = renderer.render(resident, CAMERA, outputs)
        if count != 50000:  # of which a processor has room for all, a GPU not
            assert ("packed splats" in renderer.backend.pool._buffers) == (count > 50000), (
                "it was drawn in slices"
            )
        assert all(np.array_equal(frame[name], expected[name]) for name in outputs)
        assert renderer.backend.pool.memory_bytes + resident.memory_bytes <= budget, count


PICTURES = {
    "plain": {},
    "all": {"outputs": (*ALL_OUTPUTS, "splat_id"), "background": fs.Panorama(np.ones((64, 128, 3)))},
    "boxes before a lens": {"camera": fs.Camera.fisheye(161, 117, 3.0)},
    "rolling shutter": {
        "camera": fs.Camera.pinhole(161, 117, 150.0, 150.0, 80.0, 60.0, lens=fs.BrownConrady(-0.1)),
        "motion": fs.Motion(lambda time: np.eye(4)),
        "shutter": fs.Shutter(readout=0.1, exposure_time=0.05, sub_poses=2),
    },
}


@pytest.mark.parametrize(
    ("name", "mebibytes", "machine"),
    alternate(
        {name: name for name in PICTURES}, {"in slices": 7, "at once": 64}, dict(reversed(MACHINES.items()))
    ),
)
def test_a_plan_counts_all_memory_of_a_frame(opencl, monkeypatch, machine, mebibytes, name):
    """Everything that is new on the device, the cloud and a lens's rays included."""
    renderer = machine(opencl, mebibytes * 2**20)
    pool, measured, planned = renderer.backend.pool, [], []
    fresh, trim = pool.allocate, pool.trim
    monkeypatch.setattr(
        pool, "allocate", lambda what, size: measured.append((what, size)) or fresh(what, size)
    )
    monkeypatch.setattr(pool, "trim", lambda kind, *way: planned.append(way[0]) or trim(kind, *way))
    some = random_splats(60000, seed=3, depth=(1.0, 6.0), scale=(1e-3, 1e-2), sh_degree=1)
    some = some.with_boxes(np.arange(60000) < 30000) if name == "boxes before a lens" else some
    quality = fs.Quality(alpha_cutoff=1 / 255)
    renderer.render(some, **{"camera": CAMERA, "quality": quality, **PICTURES[name]})["rgb"]
    largest = {}
    for what, size in measured:
        # a lens's rays are many buffers of one name, the others replace one another
        many = what.startswith("ray")
        largest[what] = largest.get(what, 0) + size if many else max(largest.get(what, 0), size)
    assert ("packed splats" in largest) == (mebibytes == 7)
    budget = mebibytes * 2**20
    # an eighth is for pairs alone, however few there are
    rest = sum(size for what, size in largest.items() if what not in ("pairs", "lists"))
    assert rest <= budget - planned[-1] - budget // 8 <= budget


def test_a_panorama_is_copied_once(opencl, monkeypatch):
    """As long as it is the one that was rendered last; images show theirs, whatever was there before."""
    renderer = fs.Renderer(opencl.device.name)
    rng = np.random.default_rng(0)
    one, other = (fs.Panorama(rng.random((33, 70, 3))) for _ in range(2))
    copied, copy = [], cl.enqueue_copy
    monkeypatch.setattr(
        cl, "enqueue_copy", lambda *args, **more: copied.append(args[2]) or copy(*args, **more)
    )
    some, shutter = random_splats(20, seed=9), fs.Shutter(exposure_time=0.1, sub_poses=2)

    def draw(around, **more):
        copied.clear()
        rgb = renderer.render(some, CAMERA, background=around, **more)["rgb"]
        return rgb, sum(array is around.image for array in copied)

    first, times = draw(one)
    assert times == 1
    again, times = draw(one)
    assert times == 0
    assert np.array_equal(first, again)
    _, times = draw(one, motion=fs.Motion(lambda time: np.eye(4)), shutter=shutter)
    assert times == 0
    second, times = draw(other)
    assert times == 1
    assert not np.array_equal(first, second)
    again, times = draw(one)
    assert times == 1
    assert np.array_equal(first, again)
    renderer.backend.release_scratch()
    again, times = draw(one)
    assert times == 1
    assert np.array_equal(first, again)


def test_a_panorama_of_any_memory_order_is_the_same(opencl):
    image = np.random.default_rng(1).random((20, 40, 3))
    pictures = [
        opencl.render(fs.SplatCloud.empty(), CAMERA, background=fs.Panorama(each))["rgb"]
        for each in (image, np.asfortranarray(image), image[:, ::-1][:, ::-1])
    ]
    assert all(np.array_equal(pictures[0], other) for other in pictures)


def test_neither_frames_nor_kernels_keep_a_cloud(opencl):
    """Not its buffers, and not the host's arrays that a CPU reads."""
    some = random_splats(100, seed=7)
    array, before = some.means, sys.getrefcount(some.means)
    resident = opencl.upload(some)
    data = weakref.ref(resident.data)
    frame = opencl.render(resident, CAMERA)
    del resident
    assert data() is None
    del some
    assert sys.getrefcount(array) <= before
    assert frame["rgb"].any()
    assert frame.stats["splats"] == 100


def test_a_leased_buffer_has_the_size_that_was_requested(opencl):
    pool = fs.Renderer(opencl.device.name).backend.pool
    pool.release([("plane", pool.allocate("plane", 64)), ("plane", pool.allocate("plane", 64))])
    assert pool.acquire("plane", 4096).size == 4096
    buffer = pool.allocate("plane", 4096)
    pool.release([("plane", buffer)])
    assert pool.acquire("plane", 4096) is buffer


def test_an_image_that_cannot_be_read_is_an_error_of_the_device(opencl):
    frame = opencl.render(random_splats(10, seed=8), CAMERA)
    frame._images._rendered[0].acquired["rgb_out"] = opencl.backend.pool.allocate("too small", 16)
    with pytest.raises(fs.DeviceError, match="failed while rendering rgb"):
        frame["rgb"]


def views_until(failing):
    """Two good cameras, then `failing`."""
    for x in (-0.5, 0.5):
        yield fs.Camera.look_at(40, 30, 1.0, (x, 0.0, -0.1), (0.0, 0.0, 3.0))
    yield failing()


@pytest.mark.parametrize("error", [fs.InputError, KeyError])
def test_views_before_an_error_are_given(renderer, error):
    """Whether the next camera cannot be had or cannot be rendered."""

    def failing():
        if error is KeyError:
            raise KeyError("no more")
        return "no camera"

    names = (name for name in ("rgb", "alpha"))  # walked once, used for every view
    frames = renderer.render_views(
        random_splats(30, seed=4), views_until(failing), names, background=iter((0, 1, 0))
    )
    seen = [next(frames), next(frames)]
    with pytest.raises(error):
        next(frames)
    assert [frame["alpha"].shape for frame in seen] == [(30, 40)] * 2
