"""Occlusion culling: occluded chunks are not rendered, and frames are bit-identical."""

import math

import numpy as np
import pytest
from agreement import ALL_OUTPUTS
from store_views import TURNED, build_small_store, look, splats

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.effects.select import with_termination_depths
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.store import subchunks
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.streaming import occlusion_culling, occlusion_test
from fidsplat.streaming.level_of_detail import select


def walls():
    """Two walls at a corner, opaque, with a door."""
    across, up = np.meshgrid(np.arange(-6, 3.1, 0.1), np.arange(-2.5, 2.5, 0.1))
    wall = (np.abs(across - 1.2) > 0.3) | (up < 0)
    flat = np.column_stack([across[wall], up[wall], np.full(wall.sum(), 3.0)])
    flat = np.concatenate([flat, flat * [1, 1, 1.02]])
    turned = np.repeat([[1, 0, 0, 0], [1, 0, 1, 0]], len(flat), axis=0)
    means = np.concatenate([flat, flat[:, [2, 1, 0]]])
    sizes, opacities = np.full((len(means), 2), 0.12), np.full(len(means), 0.99)
    colors = np.random.default_rng(0).uniform(size=(len(means), 3))
    return fs.SplatCloud(means, turned, sizes, opacities, colors=colors).with_labels(4)


def bushes():
    """Around and behind them."""
    generator = np.random.default_rng(1)
    middles = generator.uniform(-1, 1, (300, 3)) * [11, 1.5, 11]
    means = np.repeat(middles, 160, axis=0) + generator.uniform(-0.2, 0.2, (48000, 3))
    quats, colors = generator.normal(size=(len(means), 4)), generator.uniform(size=(len(means), 3))
    opacities = generator.uniform(0.2, 0.9, len(means))
    return fs.SplatCloud(means, quats, np.full((len(means), 2), 0.04), opacities, colors=colors)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    folder = tmp_path_factory.mktemp("town")
    stores = (build_small_store(folder, cloud(), cloud.__name__) for cloud in (walls, bushes))
    return fs.Scene(stores=tuple(stores))


@pytest.fixture
def culling(monkeypatch):
    """Occlusion culling of every view; returns the splats of each first pass, and of the view."""
    rendered, counts = occlusion_culling.OcclusionCulling.render, []
    monkeypatch.setattr(occlusion_culling, "MIN_SPLATS", 0)
    monkeypatch.setattr(occlusion_culling, "_INITIAL_SPLATS", 3000)
    monkeypatch.setattr(occlusion_culling, "_PROBE_DIVISOR", 1)
    monkeypatch.setattr(occlusion_culling, "_PAUSE", 0)
    monkeypatch.setattr(subchunks, "ROWS", 24)

    def noted(self, whole, *given):
        images = rendered(self, whole, *given)
        counts.append((whole.count if images is None else images[0][0].count, whole.count))
        return images

    monkeypatch.setattr(occlusion_culling.OcclusionCulling, "render", noted)
    return counts


def view(turn=0.0, along=0.0, size=(192, 108)):
    at = np.array([along, 0.0, 0.0])
    towards = at + np.array([math.sin(turn), 0.0, math.cos(turn)])
    return fs.Camera.look_at(*size, math.radians(60), at, towards)


SMALL = 96, 54
"""for what takes processors long: fragments by their own depth, schedules of GPUs, many samples"""
PLACES = [(0.0, 0.0), (0.05, 0.1), (1.6, -2.0), (1.7, -7.0)]
PATH = [view(*place, SMALL) for place in PLACES]
QUALITIES = {
    "centres": "lowpass=screen",
    "pixels": "lowpass=screen,order=pixel",
    "samples": "lowpass=none,samples=2",
    "exclusive": "stop_rule=exclusive,order=centre",
    "never": "transmittance_stop=0",
    "widened": "lowpass=pixel,alpha_cutoff=1e-8",
    "widened pixels": "lowpass=pixel,order=pixel",
}


@pytest.mark.sweep
@pytest.mark.parametrize(
    ("name", "schedule"),
    [*((name, "own") for name in QUALITIES), ("centres", "groups"), ("pixels", "groups")],
)
def test_frames_are_bit_identical_to_those_of_all_splats(town, culling, name, schedule):
    renderer = fs.Renderer("opencl")
    if schedule == "groups":
        renderer.backend.config = renderer.backend.configs("schedule")["groups"]
    cloud, resident = town.cloud(), renderer.upload(town)
    asking, path = {"quality": QUALITIES[name], "outputs": ALL_OUTPUTS}, PATH
    if "pixels" in name:
        path = PATH[::2]
    if schedule == "groups":
        asking["outputs"], path = ("rgb", "splat_id"), [view(size=(64, 36))]
    for number, frame in enumerate(renderer.render_views(resident, path, **asking)):
        full_frame = renderer.render(cloud, path[number], **asking)
        for output in full_frame:
            assert np.array_equal(frame[output], full_frame[output]), (output, number)
    assert len(culling) == len(path)
    if name in ("centres", "pixels", "samples"):
        assert culling[0][0] < 0.95 * culling[0][1]


def test_occluded_chunks_are_not_read(town, culling):
    renderer = fs.Renderer("opencl")
    resident = renderer.upload(town)
    for _ in renderer.render_views(resident, PATH[:2]):
        pass
    features, view = prepare(resident.all_splats, fs.Capture(PATH[1]))
    seen = select(resident.all_splats, [view], features)
    assert len(resident.data._cache._slots) < 0.95 * len(seen)
    assert resident.data.node_count < 0.95 * len(seen)


def test_a_repeated_view_is_rendered_in_one_pass(town, culling, monkeypatch):
    renderer, times = fs.Renderer("opencl"), []
    ask = type(renderer.backend).termination_depths
    monkeypatch.setattr(
        type(renderer.backend),
        "termination_depths",
        lambda self, images: times.append(1) or ask(self, images),
    )
    resident = renderer.upload(town)
    renderer.render(resident, view())
    first, _ = len(times), times.clear()
    assert first > 1
    renderer.render(resident, view())
    assert len(times) == 1


@pytest.mark.sweep
@pytest.mark.parametrize("name", ["centres", "pixels", "samples", "odd samples", "groups", "bands"])
def test_missing_chunks_are_rendered_in_their_tiles(town, culling, monkeypatch, name):
    """With termination depths that are too near, visible chunks are missing in the first pass."""
    monkeypatch.setattr(occlusion_culling, "_MOTION_SLACK", -6.0)
    monkeypatch.setattr(occlusion_culling, "_PATCH_RATIO", 1)
    size = {"odd samples": (48, 27), "groups": SMALL, "pixels": (128, 72)}.get(name, (192, 108))
    path = [view(*place, size) for place in ((0.0, 0.0), (0.02, 0.1), (0.03, 0.5))]
    renderer, measured = fs.Renderer("opencl"), []
    backend = type(renderer.backend)
    take, outputs = backend.copy_tiles, ALL_OUTPUTS if name != "groups" else ("rgb", "splat_id")

    def noted(self, images, other, tiles):
        own, others = (dict(each.stats) for each in (images, other))
        take(self, images, other, tiles)
        assert images.stats == {name: own[name] + others[name] for name in own}
        measured.append(tiles.mean())

    monkeypatch.setattr(backend, "copy_tiles", noted)
    if name == "groups":
        renderer.backend.config = renderer.backend.configs("schedule")["groups"]
    quality = {**QUALITIES, "odd samples": "samples=3", "groups": "", "bands": ""}[name] or None
    drawing = fs.SeveralDevices(["opencl", "opencl"]) if name == "bands" else renderer
    resident, cloud = drawing.upload(town), town.cloud()
    for camera in path:
        frame = drawing.render(resident, camera, quality=quality, outputs=outputs)
        full_frame = renderer.render(cloud, camera, quality=quality, outputs=outputs)
        for output in full_frame:
            assert np.array_equal(frame[output], full_frame[output]), output
    # pixels with samples in two tiles need a complete pass
    assert bool(measured) == (name != "odd samples")
    assert not measured or min(measured) < 0.4


def test_views_of_similar_size_reuse_memory(town, culling, monkeypatch):
    renderer, fresh = fs.Renderer("opencl"), []
    pool, resident = renderer.backend.pool, renderer.upload(town)
    make, counts = pool.allocate, []
    monkeypatch.setattr(pool, "allocate", lambda name, size: fresh.append(name) or make(name, size))
    for turn, along in ((0.0, 0.0), (0.02, 0.05), (0.06, 0.15), (0.06, 0.2)):
        before = len(fresh)
        frame = renderer.render(resident, view(turn, along))
        assert frame["rgb"].any()
        counts.append((frame.stats["splats"], len(fresh) - before))
    # buffers grow with the first views
    assert counts[2][0] > counts[1][0] > counts[0][0]
    assert [memory for _, memory in counts[2:]] == [0, 0]


def test_transparent_splats_occlude_nothing(tmp_path, culling, monkeypatch):
    monkeypatch.setattr(occlusion_culling, "_PAUSE", 2)
    monkeypatch.setattr(occlusion_culling, "_PROBE_DIVISOR", 4)
    monkeypatch.setattr(occlusion_culling, "_INITIAL_SPLATS", 500)
    cloud = splats(4)
    faint = fs.SplatCloud(
        cloud.means, cloud.quats, cloud.scales, np.full(len(cloud), 0.05, np.float32), colors=cloud.colors
    )
    store, renderer = build_small_store(tmp_path, faint, "faint"), fs.Renderer("opencl")
    resident = renderer.upload(store)
    for _ in range(4):
        assert np.array_equal(renderer.render(resident, look())["rgb"], renderer.render(faint, look())["rgb"])
    assert len(culling) == 2  # and then not for two views
    assert all(count > 0.6 * of for count, of in culling)  # pieces next to the image are left out


@pytest.mark.sweep
def test_levels_of_detail_and_instances_are_culled(town, tmp_path, culling, monkeypatch):
    poses = [np.eye(4), rigid_matrix((1, 0, 16)), rigid_matrix((-2, 0, 30))]
    places = fs.Store(fs.place_store(town.stores[1], tmp_path / "places.fss", poses))
    whole = fs.Scene(stores=(town.stores[0], places))
    renderer, scene = fs.Renderer("opencl"), ChunkedSplats(whole.stores)
    resident = renderer.upload(whole)
    monkeypatch.setattr(ChunkedSplats, "cell_sizes", lambda self, *qualities: 4.0)
    features, shot = prepare(scene, fs.Capture(view()))
    assert any(
        places.nodes["level"][node % len(places.nodes)]
        for node in select(scene, [shot], features, 4.0).nodes[1]
    )
    for camera in PATH[:3]:
        ours = renderer.render(resident, camera, outputs=("rgb", "depth", "splat_id"))
        monkeypatch.setattr(occlusion_culling, "MIN_SPLATS", 1 << 60)
        every = renderer.render(renderer.upload(whole), camera, outputs=("rgb", "depth", "splat_id"))
        monkeypatch.setattr(occlusion_culling, "MIN_SPLATS", 0)
        for output in every:
            assert np.array_equal(ours[output], every[output])
    assert all(count < 0.9 * of for count, of in culling)


def test_bands_of_several_devices_are_culled_separately(town, culling):
    devices, renderer = fs.SeveralDevices(["opencl", "opencl"]), fs.Renderer("opencl")
    there = devices.upload(town)
    for camera in PATH[:3]:
        full_frame = renderer.render(town.cloud(), camera)["rgb"]
        assert np.array_equal(devices.render(there, camera)["rgb"], full_frame)
    assert any(count < of for count, of in culling)


def test_too_little_memory_for_visible_chunks(town, culling):
    renderer = fs.Renderer("opencl", memory_budget=4 * 2**20)
    resident = renderer.upload(town)
    full_frame = fs.Renderer("opencl").render(town.cloud(), view())["rgb"]
    assert np.array_equal(renderer.render(resident, view())["rgb"], full_frame)


CAPTURES = {
    "pinhole": fs.Capture(look(turn=TURNED)),
    "off-centre": fs.Capture(look(center=(-30.0, 50.0), turn=TURNED)),
    "by pixel": fs.Capture(look(turn=TURNED), quality="order=pixel"),
    "samples": fs.Capture(look(at=(2, 1, -1)), quality="samples=2,order=pixel,lowpass=none"),
    "exact": fs.Capture(look(turn=TURNED), quality="ellipsoid=exact,order=pixel"),
    "widened": fs.Capture(look(turn=TURNED), quality="lowpass=pixel,alpha_cutoff=1e-8"),
    "widened by pixel": fs.Capture(look(turn=TURNED), quality="lowpass=pixel,order=pixel"),
    "parallel": fs.Capture(look(focal=20.0, turn=TURNED, lens=fs.Orthographic())),
    "fisheye": fs.Capture(look(focal=16.0, turn=TURNED, lens=fs.Fisheye()), quality="order=pixel"),
}


@pytest.mark.sweep
@pytest.mark.parametrize("name", CAPTURES)
def test_splats_are_within_the_bounds_of_their_box(name):
    """Each splat, against the key and rectangle that the device computes."""
    cloud, backend = splats(2, thick=True), fs.Renderer("opencl").backend
    capture = CAPTURES[name].with_(outputs=("alpha",))
    features, view = prepare(cloud, capture)
    buffers = backend.pipeline(features).render_intermediates(backend.upload(cloud), view)
    assert cloud.thickness is not None
    largest = np.maximum(cloud.scales.max(axis=1), cloud.thickness).astype(np.float64)

    def boxes(sigmas):
        return cloud.means - sigmas * largest[:, None], cloud.means + sigmas * largest[:, None]

    shown = np.flatnonzero(buffers["keys"] < 0xFFFFFFFE)
    keys = TerminationDepths.of_keys(buffers["keys"], (1, 1)).depths
    least = occlusion_test.min_sort_keys(view, features, boxes)
    assert (least[shown] <= keys[shown]).all()
    # one tile for each sample: only tiles that the splat touches do not terminate
    records, rectangles = buffers["records"], np.full((len(cloud), 4), -1)
    for i in shown:
        rectangles[i] = records["y0"][i], records["y1"][i], records["x0"][i], records["x1"][i]
    for i in shown[:: max(1, len(shown) // 50)]:
        depths = np.full((view.height, view.width), -np.inf, np.float32)
        y0, y1, x0, x1 = rectangles[i]
        for row, column in ((y0, x0), (y0, x1 - 1), (y1 - 1, x0), (y1 - 1, x1 - 1)):
            depths[row, column] = np.inf
            given = TerminationDepths(depths, (1, 1))
            only = lambda sigmas, i=i: tuple(each[i : i + 1] for each in boxes(sigmas))  # noqa: E731
            assert not occlusion_test.occluded(view, features, only, largest[i : i + 1], given).any()
            depths[row, column] = -np.inf


@pytest.mark.sweep
@pytest.mark.parametrize("schedule", ["own", "groups"])
@pytest.mark.parametrize("order", ["centre", "pixel"])
def test_tiles_terminate_where_all_pixels_are_opaque(order, schedule):
    """Opaque boxes over parts of tiles."""
    generator, backend = np.random.default_rng(3), fs.Renderer("opencl").backend
    if schedule == "groups":
        backend.config = backend.configs("schedule")["groups"]
    means = np.column_stack([generator.uniform(-1.5, 1.5, (60, 2)), generator.uniform(2.0, 4.0, 60)])
    sizes = generator.uniform(0.03, 0.6, (60, 2))
    upright, opaque = np.tile([1.0, 0, 0, 0], (60, 1)), np.ones(60)
    cloud = fs.SplatCloud(means, upright, sizes, opaque, colors=np.ones((60, 3))).with_boxes(True)
    camera = fs.Camera.pinhole(96, 64, 60.0, 60.0, 48.0, 32.0)
    capture = fs.Capture(camera, outputs=("alpha", "depth"), quality=f"lowpass=none,order={order}")
    features, shot = prepare(cloud, capture)
    images = backend.pipeline(with_termination_depths(features)).render_view(backend.upload(cloud), shot)
    depths = backend.termination_depths(images)
    height, width = depths.tile
    rows, columns = depths.depths.shape
    tiles = [(row, column) for row in range(rows) for column in range(columns)]
    alpha, depth = (images.read(name, 0).reshape(64, 96) for name in ("alpha", "depth"))
    finished = np.zeros((rows, columns), bool)
    for row, column in tiles:
        own = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
        finished[row, column] = (alpha[own] >= 1 - 1e-4).all()
        if finished[row, column]:
            assert depths.depths[row, column] >= depth[own].max()
    assert 3 < finished.sum() < len(tiles) - 3
    ends_known = np.isfinite(depths.depths)
    assert not (ends_known & ~finished).any()
    # work-groups test batches of a list by centres, and these lists are shorter than one
    assert np.array_equal(ends_known, finished) or (order, schedule) == ("centre", "groups")


def test_termination_depths_of_selected_tiles():
    """-inf in the others; and replacement by those of another frame."""
    depths, tiles = (
        np.array([[1.0, np.inf], [3.0, 4.0]], np.float32),
        np.array([[True, True], [False, False]]),
    )
    some = TerminationDepths(depths, (16, 16))
    assert np.array_equal(some.within(tiles).depths, [[1.0, np.inf], [-np.inf, -np.inf]])
    others = TerminationDepths(np.full((2, 2), 7, np.float32), (16, 16))
    assert np.array_equal(some.replaced(tiles, others).depths, [[7.0, 7.0], [3.0, 4.0]])


def test_range_maximum():
    generator = np.random.default_rng(0)
    values = generator.normal(size=(13, 21))
    tops, lefts = generator.integers(0, 13, 300), generator.integers(0, 21, 300)
    bottoms, rights = generator.integers(0, 14, 300), generator.integers(0, 22, 300)
    actual = occlusion_test._RangeMaximum(values).within(tops, bottoms, lefts, rights)
    for k, (top, bottom, left, right) in enumerate(zip(tops, bottoms, lefts, rights, strict=True)):
        assert actual[k] == values[top:bottom, left:right].max(initial=-np.inf)


def test_a_needle_that_ewa_widens_is_not_occluded():
    focal = 1000 / math.tan(math.radians(80))
    camera = fs.Camera.pinhole(2000, 2, focal, focal, 1000, 1)
    sigmas = np.array([[1e-3, 1e-3, 0.06]], np.float32)
    means = np.array([[-7.6, 0, 1]], np.float32)
    needle = fs.SplatCloud(means, [[1, 0, 0, 0]], sigmas, [0.99], colors=[[1, 1, 1]])
    nowhere_finished = TerminationDepths(np.full((1, 125), np.inf, np.float32), (16, 16))
    features, shot = prepare(needle, fs.Capture(camera, quality=fs.Quality(ellipsoid="ewa")))
    given = shot, features, lambda count: (means - count * sigmas, means + count * sigmas)
    assert not occlusion_test.occluded(*given, sigmas.max(axis=1), nowhere_finished).any()
