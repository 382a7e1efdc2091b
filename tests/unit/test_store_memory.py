"""Chunk cache of a device, and bands, within the memory budget."""

import gc
import threading
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from store_views import TURNED, build_small_stores, look

import fidsplat as fs
from fidsplat.backends.opencl import buffers, chunk_cache
from fidsplat.backends.opencl.pipeline import OpenCLPipeline
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.streaming import bands
from fidsplat.streaming.device_chunks import DeviceChunks


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    return build_small_stores(tmp_path_factory.mktemp("stores"))


def test_chunks_are_sent_to_a_device_once(stores, tmp_path, monkeypatch):
    cache = chunk_cache.OpenCLChunkCache
    sent, load = [], cache._load
    monkeypatch.setattr(cache, "_load", lambda self, key, *rest: sent.append(key) or load(self, key, *rest))
    renderer, store = fs.Renderer("opencl"), stores["disks"]
    resident, cameras = renderer.upload(store), [look(), look(turn=TURNED), look()]
    for camera in cameras:
        assert np.array_equal(
            renderer.render(resident, camera)["rgb"], renderer.render(store.cloud(), camera)["rgb"]
        )
    assert 0 < len(sent) == len(set(sent)) <= store.chunks
    # splats of an instanced store are sent once
    sent.clear()
    placed = fs.Store(fs.place_store(store, tmp_path / "p.fss", [np.eye(4), rigid_matrix((0, 0, 0.5))]))
    renderer.render(renderer.upload(placed), look())
    assert len(sent) == len(set(sent)) <= store.chunks


def test_gathered_parts_can_begin_within_a_chunk(stores):
    backend, scene = fs.Renderer("opencl").backend, ChunkedSplats([stores["disks"]])
    device_chunks = DeviceChunks(scene)
    gathered = backend.chunk_cache(device_chunks).gather(device_chunks.of(scene.all_chunks(), True))
    gathered.streamed = True
    actual = np.empty(130, np.float32)
    cl.enqueue_copy(backend.queue, actual, gathered.array_in_cloud_order("opacities", 70, 200))
    assert np.array_equal(actual, stores["disks"].cloud().opacities[70:200])


def test_cache_content_survives_a_failed_growth(stores, monkeypatch):
    """Also with slow copies, and if only the first of two arrays fits."""
    renderer, store = fs.Renderer("opencl"), stores["disks"]
    resident = renderer.upload(store)
    renderer.render(resident, look())
    cache, pool, requested = resident.data._cache, renderer.backend.pool, []
    fresh = pool.allocate

    def full(name, size):
        requested.append(name)
        if len(requested) == 2:
            raise fs.DeviceError("no memory")
        return fresh(name, size)

    def contents_of(name):
        actual = np.empty(before[name].size, np.uint8)
        cl.enqueue_copy(renderer.backend.queue, actual, cache._arrays[name])
        return actual

    before = dict(cache._arrays)
    expected = {name: contents_of(name) for name in before}
    held = cl.UserEvent(renderer.backend.context)
    cl.enqueue_barrier(cache._queue, wait_for=[held])
    threading.Timer(0.2, held.set_status, [cl.command_execution_status.COMPLETE]).start()
    with monkeypatch.context() as patch:
        patch.setattr(pool, "allocate", full)
        with pytest.raises(fs.DeviceError, match="no memory"):
            cache._grow(2 * cache._size)
    assert sum(buffer is not before[name] for name, buffer in cache._arrays.items()) == 1
    assert all(np.array_equal(contents_of(name), array) for name, array in expected.items())


def test_a_cache_smaller_than_a_view(stores, monkeypatch):
    renderer, store = fs.Renderer("opencl"), stores["disks"]
    # two chunks fit, and no frame is gathered at once
    monkeypatch.setattr(chunk_cache, "_CACHE_DIVISOR", renderer.backend.memory_budget // 10000)
    monkeypatch.setattr(chunk_cache, "_CLOUD_DIVISOR", renderer.backend.memory_budget // 10000)
    resident, outputs = renderer.upload(store), ("rgb", "splat_id")
    for camera in (look(), look(turn=TURNED)):
        ours, full_frame = (renderer.render(each, camera, outputs) for each in (resident, store.cloud()))
        for output in outputs:
            assert np.array_equal(ours[output], full_frame[output]), output
    cache, scene, device_chunks = resident.data._cache, resident.data.scene, resident.data.chunks
    held = set(cache._slots)
    assert 0 < len(held) <= 2
    # prefetching does not evict chunks of the current frame
    cache.prefetch(device_chunks.of(scene.all_chunks(), True))
    assert set(cache._slots) == held
    # nor other prefetched chunks
    every = device_chunks.of(scene.all_chunks(), True)
    cache._rendered = set()
    cache.prefetch(every[:2])
    cache.prefetch(every)
    assert set(cache._slots) == {chunk.key for chunk in every[:2]}


def facing_the_wall(x=0.0):
    return fs.Camera.look_at(120, 90, 1.4, (x, 0, -1), (x, 0, 3))


@pytest.mark.sweep
def test_views_that_do_not_fit_are_rendered_in_bands(stores, monkeypatch):
    store, rendered, most = stores["wall"], [], 5500
    cloud, plain, limited = store.cloud(), fs.Renderer("opencl"), fs.Renderer("opencl")

    def fits(self, resident, view):
        rendered.append(resident.count)
        return resident.count < most

    monkeypatch.setattr(OpenCLPipeline, "fits", fits)
    resident, outputs = limited.upload(store), ("rgb", "splat_id", "depth")
    sampled = fs.Capture(facing_the_wall(), quality="samples=2", outputs=outputs)
    moved = fs.Capture(facing_the_wall(x=0.1), outputs=outputs)
    # effects that depend on the pixel position
    sensor = fs.Sensor(gain=0.8, full_well=500, read_noise=3, vignetting=(-0.5,))
    more = ("rgb", "alpha", "depth_median", "normal", "label")
    by_pixel = fs.Capture(
        facing_the_wall(), more, "order=pixel", fog=fs.Fog(0.2, (0.5, 0.6, 0.7)), sensor=sensor
    )
    widened = fs.Capture(facing_the_wall(), outputs=outputs, quality="lowpass=pixel,alpha_cutoff=1e-8")
    for capture in (fs.Capture(facing_the_wall(), outputs=outputs), sampled, by_pixel, widened, moved):
        rendered.clear()
        ours, full_frame = limited.render(resident, capture), plain.render(cloud, capture)
        for output in capture.outputs:
            assert np.array_equal(ours[output], full_frame[output]), output
        assert sum(count < most for count in rendered) >= 2
        assert ours.stats["visible"] >= full_frame.stats["visible"]
        assert set(ours.timings) == set(full_frame.timings)
    # the next view begins with the bands of the previous one
    rendered.clear()
    limited.render(resident, moved)
    assert max(rendered) < most
    # a band of a frame is split too
    frame = limited.render_band((5, 80), resident, moved)
    assert np.array_equal(frame["rgb"][5:80], plain.render(cloud, moved)["rgb"][5:80])
    # splitting does not help where all rows need all splats
    rendered.clear()
    fisheye, most = fs.Capture(replace(facing_the_wall(), lens=fs.Fisheye())), 1
    assert np.array_equal(limited.render(resident, fisheye)["rgb"], plain.render(cloud, fisheye)["rgb"])
    assert len(rendered) == 1


def test_a_memory_budget_makes_bands(stores):
    store, camera = stores["wall"], facing_the_wall()
    limited, plain = fs.Renderer("opencl", memory_budget=2 << 20), fs.Renderer("opencl")
    resident = limited.upload(store)
    ours = limited.render(resident, camera)
    assert np.array_equal(ours["rgb"], plain.render(store.cloud(), camera)["rgb"])
    assert len(resident.data._splitter._borders[0, 90]) > 2


@pytest.mark.sweep
def test_frames_and_cached_chunks_keep_the_budget(stores, monkeypatch):
    live, peak, store = weakref.WeakSet(), [0], stores["wall"]

    class Counted(buffers.DeviceBuffer):
        def __init__(self, *given, **words):
            super().__init__(*given, **words)
            live.add(self)
            peak[0] = max(peak[0], sum(buffer.size for buffer in live))

    monkeypatch.setattr(buffers, "DeviceBuffer", Counted)
    for budget in (2200 << 10, 3 << 20):
        peak[0], limited = 0, fs.Renderer("opencl", memory_budget=budget)
        resident = limited.upload(store)
        for frame in limited.render_views(resident, [facing_the_wall(x=0.05 * k) for k in range(5)]):
            assert frame["rgb"].any()
        assert 0.5 * budget < peak[0] <= budget
        cache = resident.data._cache
        assert 0 < cache.memory_bytes <= cache.reserved_bytes <= budget // 4
        # room is left for all that the cache may come to take, whatever it holds yet
        empty = limited.backend.chunk_cache(resident.data.chunks)
        gathered = empty.gather(resident.data.chunks.of(resident.data.scene.all_chunks(), True))
        assert gathered.bytes_for(["means"])[0] == cache.reserved_bytes + 12 * gathered.padded_count
        assert len(store) <= gathered.padded_count <= 9 / 8 * len(store)
        assert empty.memory_bytes == 0
        del limited, resident, frame, cache, empty, gathered
        gc.collect()


def test_smaller_frames_reuse_buffers():
    pool = fs.Renderer("opencl").backend.pool
    pool.clear()
    pool.trim("stores", 1 << 30, 100)
    for splats, reused in ((90, True), (100, True), (101, False)):
        pool.scratch("records", 1 << 20)
        pool.trim("stores", 0, splats)
        assert bool(pool.memory_bytes) == reused
    pool.scratch("records", 1 << 20)
    pool.trim("others", 0, 1)
    assert not pool.memory_bytes


def test_bands_that_fit_together_are_merged():
    splitter = bands.BandSplitter()
    whole = SimpleNamespace(rows=(0, 64), count=64)
    whole.with_rows = lambda first, end: SimpleNamespace(
        rows=(first, end), count=end - first, with_rows=whole.with_rows,
        halves=[] if end - first < 2 else [whole.with_rows(first, (first + end) // 2),
                                           whole.with_rows((first + end) // 2, end)],
    )  # fmt: skip
    assert [band.rows for band in splitter.split(whole, lambda band: band.count <= 20)] == [
        (0, 16), (16, 32), (32, 48), (48, 64)
    ]  # fmt: skip
    assert len(list(splitter.split(whole, lambda band: band.count <= 20))) == 4
    assert len(list(splitter.split(whole, lambda band: band.count <= 8))) == 8
    assert len(list(splitter.split(whole, lambda band: True))) == 8
    splitter._capacity = 33
    list(splitter.split(whole, lambda band: True))
    assert splitter._borders == {(0, 64): [0, 32, 64]}
