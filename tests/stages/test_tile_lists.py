"""Tile binning: equal lists by all strategies, of any length, and with small buffers."""

from dataclasses import replace

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, random_splats
from stage_buffers import CAMERA, CULLED, intermediates_of, listing

import fidsplat as fs
from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.opencl import pipeline as pipeline_module
from fidsplat.backends.opencl import tiling
from fidsplat.backends.prepare import prepare, prepare_batch
from fidsplat.backends.view import View
from fidsplat.capture.views import capture_batch
from fidsplat.effects import select
from fidsplat.selftest.agreement import out_of_order


@pytest.mark.parametrize("scale", [(1e-3, 0.5), (0.1, 50.0)])
def test_binning_strategies_make_equal_lists(backend, scale):
    """Small splats, and splats that overlap more tiles than a window of list/tiled.cl."""
    cloud = random_splats(2500, seed=5, scale=scale)
    tiled, ordered = (
        intermediates_of(backend, cloud, fs.Quality(lowpass="none"), shape=listing(backend, lists))[0]
        for lists in ("bin_first", "sort_first")
    )
    assert max(np.diff(tiled["starts"].astype(int))) > 20
    # both list every tile that a splat overlaps (test_stages.py), and few others
    different = 0
    for tile in range(len(tiled["starts"]) - 1):
        ours, theirs = (t["lists"][t["starts"][tile] : t["starts"][tile + 1]] for t in (tiled, ordered))
        different += len(set(theirs) ^ set(ours))
    assert different <= 0.05 * len(ordered["lists"])
    assert np.array_equal(tiled["rgb"], ordered["rgb"])


@pytest.mark.parametrize("binning", ["bin_first", "sort_first"])
def test_the_probe_sums_list_lengths(backend, binning):
    pipeline = backend.pipeline(
        select(random_splats(10, seed=5), fs.Capture(CAMERA)), listing(backend, binning)
    )
    lengths = np.array([3, 0, 2**31, 5], np.uint32)
    starts, total = backend.probe().scan(pipeline, lengths)
    assert total == lengths.sum(dtype=np.uint64)
    assert np.array_equal(starts, np.concatenate([[0], np.cumsum(lengths)]))


def test_no_splat_of_a_complete_image_is_outside_of_its_band(backend):
    """Large splats behind the camera, and a last row of tiles below the image: a splat outside of the band
    has no window, and binning would read unwritten memory."""
    cloud = random_splats(3000, seed=7, depth=(-4, 4), scale=(0.1, 0.5), across=3.0)
    camera = fs.Camera.pinhole(33, 17, 30.0, 30.0, 5.0, 3.0)
    features, view = prepare(cloud, fs.Capture(camera, quality=fs.Quality(lowpass="pixel")))
    assert view.height % backend.config.tile_height
    buffers = backend.pipeline(features).render_intermediates(backend.upload(cloud), view)
    assert not (buffers["keys"] == CULLED - 1).any()


@pytest.mark.parametrize(
    ("lists", "budget"), [("sort_first", 0), ("bin_first", 0), ("bin_local", 0), ("bin_local", 5000)]
)
def test_views_of_a_batch_have_separate_lists(backend, monkeypatch, lists, budget):
    """local: few tiles, counted in local memory by groups of 4096 splats; a pair budget makes bands."""
    cloud = random_splats(5000, seed=5, scale=(1e-3, 0.5))
    quality = fs.Quality(lowpass="none")
    captures = [
        fs.Capture(fs.Camera.look_at(161, 117, 1.0, (x, 0.0, -0.1), (0.0, 0.0, 3.0)), ALL_OUTPUTS, quality)
        for x in (-1.0, 0.5)
    ]
    features, batch = prepare_batch(cloud, capture_batch(captures))
    shape = listing(backend, "bin_first" if lists == "bin_local" else lists)
    pipeline, resident = backend.pipeline(features, shape), backend.upload(cloud)
    alone = [pipeline.render_view(resident, prepare(cloud, capture)[1]) for capture in captures]
    original = tiling.launch_local
    launched = []

    def launch(self, kernel, **given):
        launched.append(kernel)
        original(self, kernel, **given)

    monkeypatch.setattr(tiling, "launch_local", launch)
    if lists == "bin_first":
        monkeypatch.setattr(tiling, "LOCAL_TILES", 0)
    monkeypatch.setattr(backend, "pair_budget", budget or backend.pair_budget)
    batch_images = pipeline.render(resident, batch)
    assert (launched.count("emit_local") > (2 if budget else 0)) == (lists == "bin_local")
    for name in ("visible", "pairs"):
        assert batch_images.stats[name] == sum(images.stats[name] for images in alone)
    for images, own in zip(batch_images.read("rgb"), alone, strict=True):
        assert np.array_equal(images, own.read("rgb", 0))


@pytest.mark.parametrize("budget", [0, 5000])
def test_stores_are_binned_in_local_memory(backend, monkeypatch, budget):
    """Groups of 4096 splats that are close together, outside of the image, or spread over more tiles than
    local memory holds; then replayed, and rendered as one view of two."""
    generator = np.random.default_rng(8)
    cloud = random_splats(3 * 4096 + 50, seed=5, scale=(1e-3, 0.03))
    means, near = cloud.means.copy(), generator.normal(size=(2 * 4096, 3)).astype(np.float32)
    means[: 2 * 4096] = [0.7, 0.4, 3.0] + [0.1, 0.1, 0.3] * near
    means[4096 : 2 * 4096, 0] -= 6.0
    cloud = fs.SplatCloud(means, cloud.quats, cloud.scales, cloud.opacities, colors=cloud.colors)
    camera = fs.Camera.look_at(641, 549, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
    capture = fs.Capture(camera, ("rgb",), fs.Quality(lowpass="none"))
    features, view = prepare(cloud, capture)
    pipeline, resident = backend.pipeline(features, listing(backend, "bin_first")), backend.upload(cloud)
    expected = pipeline.render_view(resident, view)
    assert 1000 < expected.stats["visible"] < 2.2 * 4096
    original, launched = tiling.launch_local, []

    def launch(self, kernel, **given):
        launched.append(kernel)
        original(self, kernel, **given)

    monkeypatch.setattr(tiling, "launch_local", launch)
    monkeypatch.setattr(backend, "pair_budget", budget or backend.pair_budget)
    resident = backend.upload(cloud)
    resident.is_spatially_sorted = True
    for _ in range(3):
        images = pipeline.render_view(resident, view)
        assert images.stats == expected.stats
        assert np.array_equal(images.read("rgb"), expected.read("rgb"))
    # in bands each time; else twice, then replayed
    assert launched.count("count_local") == (3 if budget else 2)
    moved = replace(capture, camera=fs.Camera.look_at(641, 549, 1.0, (0.3, 0.0, 0.0), (0.0, 0.0, 3.0)))
    batch_images = pipeline.render(resident, prepare_batch(cloud, capture_batch([moved, capture]))[1])
    other = pipeline.render_view(backend.upload(cloud), prepare(cloud, moved)[1])
    for images, own in zip(batch_images.read("rgb"), (other, expected), strict=True):
        assert np.array_equal(images, own.read("rgb", 0))
    assert launched.count("count_local") > (3 if budget else 2)


def test_splats_culled_before_projection(backend, monkeypatch):
    """Large clouds have records only for splats that may be visible, in Morton order; splats of equal depth
    are blended in the order of their indices. Views of few, of none, of more than the buffers hold, which
    are rendered again when they are read, of few again, and of few after a frame in the cloud's order."""
    cloud, outputs = random_splats(9000, seed=5, scale=(1e-3, 0.05), across=1.5), ("rgb", "splat_id")
    means = cloud.means.copy()
    means[:, 2] = np.round(8 * means[:, 2]) / 8
    cloud = fs.SplatCloud(means, cloud.quats, cloud.scales, cloud.opacities, colors=cloud.colors)
    few, features = random_splats(300, seed=6), prepare(cloud, fs.Capture(CAMERA, outputs))[0]
    eyes = [(0.0, 0.0, 3.2), (0.0, 0.0, 50.0), (0.0, 0.0, 1.0), (0.3, 0.0, 3.0)]
    views = [
        prepare(cloud, fs.Capture(fs.Camera.look_at(161, 117, 1.0, eye, (0.0, 0.0, eye[2] + 9)), outputs))[1]
        for eye in eyes
    ]
    rendered = []
    for least in (pipeline_module.MIN_CULLED, 1):
        monkeypatch.setattr(pipeline_module, "MIN_CULLED", least)
        own = type(backend)(backend.device)  # with new buffers
        pipeline, resident = own.pipeline(features, listing(own, "bin_first")), own.upload(cloud)
        rendered.append([pipeline.render_view(resident, view) for view in (*views, *views)])
        own.pool.clear()  # recorded again, with the buffers of a smaller cloud
        pipeline.render_view(own.upload(few), views[2])
        rendered[-1] += [pipeline.render_view(resident, view) for view in (*views, *views)]
        for images in rendered[-1]:
            images.read("rgb")
    assert resident.sortable
    culled = 32 * own.pool.size("unculled") // 4
    assert 4096 < culled < 9000
    assert own.pool.size("splats") == culled * pipeline.source.records["Splat"].itemsize
    resident.array_in_cloud_order("means", 0, resident.count)
    assert not resident.sortable
    rendered = [rendered[0] + rendered[0][:1], [*rendered[1], pipeline.render_view(resident, views[0])]]
    for images, expected in zip(*rendered, strict=True):
        assert images.stats == expected.stats
        for name in outputs:
            assert np.array_equal(images.read(name), expected.read(name), equal_nan=True), name


def test_lists_that_overflow_are_made_again(backend):
    """A frame with many more pairs and big splats than the previous one."""
    groups = listing(backend, "bin_first")
    few, many = random_splats(30, seed=2, scale=(1e-3, 0.05)), random_splats(9000, seed=2, scale=(0.5, 5.0))
    features, quality = select(few, fs.Capture(outputs=ALL_OUTPUTS)), fs.Quality()
    camera = fs.Camera.look_at(81, 59, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
    view = View.of(fs.Capture(camera, quality=quality), few.origin)
    backend = type(backend)(backend.device)  # with new buffers
    pipeline = backend.pipeline(features, groups)
    fresh = pipeline.render_view(backend.upload(many), view)
    expected = {name: fresh.read(name) for name in ALL_OUTPUTS}
    backend = type(backend)(backend.device)
    pipeline = backend.pipeline(features, groups)
    pipeline.render_view(backend.upload(few), view)
    repeated = pipeline.render_view(backend.upload(many), view)
    assert repeated.stats == fresh.stats
    assert repeated.stats["pairs"] > 1e5
    for name in ALL_OUTPUTS:
        assert np.array_equal(repeated.read(name), expected[name]), name


@pytest.mark.parametrize("spare", [1, 0, -1])
def test_a_capacity_of_exactly_the_pairs_of_a_frame(backend, spare):
    """Lists are made again if and only if they overflow."""
    cloud, quality = random_splats(3000, seed=5, scale=(1e-3, 0.5)), fs.Quality()
    groups = listing(backend, "bin_first")
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS, quality))
    rendered = []
    for extra in (None, spare):
        own = type(backend)(backend.device)  # with new buffers
        if extra is not None:
            pairs = rendered[0].stats["pairs"] + extra
            own.pool.scratch("lists", 4 * pairs)
            own.pool.scratch("pairs", 8 * pairs)
        views = ViewBatch.single(view)
        rendered.append(own.pipeline(features, groups).render(own.upload(cloud), views))
        grown = own.pool.size("pairs") > 8 * (rendered[0].stats["pairs"] + spare)
        assert extra is None or grown == (spare < 0)
    assert rendered[0].stats == rendered[1].stats
    for name in ALL_OUTPUTS:
        assert np.array_equal(rendered[0].read(name), rendered[1].read(name)), name


def test_a_list_longer_than_local_memory_is_sorted(backend):
    """tile_lists.cl sorts 2048 pairs or the indices of 8192 at once in local memory, longer lists in global
    memory as well."""
    cloud = random_splats(11000, seed=8, depth=(1.0, 9.0), scale=(0.2, 0.3), across=0.1)
    buffers, _ = intermediates_of(backend, cloud, fs.Quality(), shape=backend.configs("schedule")["groups"])
    visible = np.flatnonzero(buffers["keys"] != CULLED)
    lengths = np.diff(buffers["starts"].astype(int))
    assert max(lengths) > 8192
    assert any((lengths > 2048) & (lengths <= 8192))
    assert out_of_order(buffers, visible[np.argsort(buffers["keys"][visible], kind="stable")]) == 0


def test_unaligned_arrays_of_a_cloud(backend):
    """Unaligned arrays of a cloud, which kernels read in vectors and CPUs without a copy."""
    base = random_splats(50, seed=6)
    arrays = {"quats": base.quats, "scales": base.scales}
    for name, array in arrays.items():
        flat = np.empty(array.size + 1, np.float32)
        flat[1:] = array.ravel()
        flat.flags.writeable = False
        arrays[name] = flat[1:].reshape(array.shape)
    cloud = fs.SplatCloud(means=base.means, opacities=base.opacities, colors=base.colors, **arrays)
    assert all(getattr(cloud, name).ctypes.data % 16 for name in arrays)
    batch_images = [intermediates_of(backend, each, fs.Quality())[0]["rgb"] for each in (base, cloud)]
    assert np.array_equal(*batch_images)


DEPTHS = {
    "spread": lambda n: np.linspace(1.0, 9.0, n),
    "in pairs": lambda n: np.linspace(1.0, 9.0, n // 2).repeat(2),
    "one": lambda n: np.full(n, 3.0),
    "two": lambda n: np.where(np.arange(n) % 3 == 0, 8.0, 2.0),
    "one far away": lambda n: np.r_[np.linspace(2.0, 2.001, n - 1), 1e14],
}


@pytest.mark.parametrize("depths", DEPTHS)
def test_lists_of_all_depth_distributions_are_sorted(backend, depths):
    """tile_lists.cl uses a bucket sort by depth, and a network if a bucket is overfull."""
    n, generator = 1500, np.random.default_rng(4)
    cloud = random_splats(n, seed=4, scale=(0.05, 0.3))
    z = generator.permutation(DEPTHS[depths](n))
    cloud = fs.SplatCloud(
        means=np.stack([generator.normal(size=n) * 0.02 * z, generator.normal(size=n) * 0.02 * z, z], 1),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=cloud.scales * z[:, None],
        opacities=cloud.opacities,
        colors=cloud.colors,
    )
    camera = fs.Camera.pinhole(CAMERA.width, CAMERA.height, 150.0, 150.0, 80.0, 58.0)
    features, view = prepare(cloud, fs.Capture(camera, ALL_OUTPUTS))
    buffers = backend.pipeline(features, backend.configs("schedule")["groups"]).render_intermediates(
        backend.upload(cloud), view
    )
    visible = np.flatnonzero(buffers["keys"] != CULLED)
    longest = max(np.diff(buffers["starts"].astype(int)))
    assert 1000 < longest <= 1500
    assert out_of_order(buffers, visible[np.argsort(buffers["keys"][visible], kind="stable")]) == 0


@pytest.mark.parametrize("lists", ["sort_first", "bin_first"])
@pytest.mark.parametrize("budget", [1, 50, 1000])
def test_a_small_pair_budget_is_bit_identical(backend, monkeypatch, budget, lists):
    """Case E3: a frame with more pairs than the budget is rendered in ranges of tiles."""
    cloud = random_splats(300, seed=12)
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS))
    # the shape of a CPU for its own strategy, which uses bands most often
    shape = backend.config if lists == "sort_first" else listing(backend, lists)
    pipeline, resident = backend.pipeline(features, shape), backend.upload(cloud)
    full_frame = pipeline.render_view(resident, view)
    assert full_frame.stats["pairs"] > 1000
    monkeypatch.setattr(backend, "pair_budget", budget)
    banded = pipeline.render_view(resident, view)
    assert banded.stats == full_frame.stats
    for name in ALL_OUTPUTS:
        assert np.array_equal(banded.read(name), full_frame.read(name)), name
