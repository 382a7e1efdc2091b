"""Pictures of stores: what a view does not see is not read, and the picture is that of all splats in memory,
bit for bit."""

import copy
import gc
import math
import pickle
import threading
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from test_store import contents

import fidsplat as fs
from fidsplat.backends.opencl import chunks, workspace
from fidsplat.backends.opencl.pipeline import OpenCLPipeline
from fidsplat.backends.prepare import prepare
from fidsplat.backends.seen import seen
from fidsplat.random_clouds import random_splats
from fidsplat.rotations import rigid_matrix
from fidsplat.store import bands, plan, streamed
from fidsplat.store.sources import source_of
from fidsplat.store.streamed import Streamed

COUNT = 3000
SIZE = 40, 30


def splats(seed, thick=False, sh_degree=None):
    """Small splats on all sides of the origin."""
    cloud = random_splats(COUNT, seed, depth=(-4, 4), scale=(3e-3, 0.1), across=4.0, sh_degree=sh_degree)
    if not thick:
        return cloud
    scales = np.column_stack([cloud.scales, np.where(np.arange(COUNT) % 2, cloud.scales[:, 0], 0)])
    return fs.SplatCloud(cloud.means, cloud.quats, scales, cloud.opacities, colors=cloud.colors)


def made_store(folder, cloud, name):
    source = source_of(cloud, folder / name, "test")
    return fs.Store(fs.build_store([source], folder / f"{name}.fss", chunk=64))


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "_LEAST_MEMORY", 0)
        clouds = {"disks": splats(1), "thick": splats(2, thick=True), "sh": splats(3, sh_degree=2)}
        clouds["wall"] = random_splats(3 * COUNT, 5, depth=(3, 3.2), scale=(7e-3, 0.02), across=3.0)
        return {name: made_store(folder, cloud, name) for name, cloud in clouds.items()}


def look(fov=60.0, turn=(1.0, 0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0), **given):
    camera = fs.Camera.look_at(*SIZE, math.radians(fov), position=(0, 0, 0), target=(0, 0, 1))
    pose = np.linalg.inv(rigid_matrix(at, turn))
    focal = given.pop("focal", camera.fx)
    center = given.pop("center", (SIZE[0] / 2, SIZE[1] / 2))
    return fs.Camera.pinhole(*SIZE, focal, focal, *center, pose, **given)


TURNED = (0.8, 0.1, -0.5, 0.2)
CAPTURES = {
    "pinhole": fs.Capture(look(turn=TURNED)),
    "off-centre": fs.Capture(look(center=(-30.0, 50.0), turn=TURNED)),
    "near and far": fs.Capture(look(90, near=0.5, far=2.0)),
    "no low-pass": fs.Capture(look(at=(2, 1, -1), turn=TURNED), quality="lowpass=none"),
    "high cut-off": fs.Capture(look(turn=TURNED), quality="gsplat"),
    "samples": fs.Capture(look(), quality="samples=2"),
    "pixel": fs.Capture(look(turn=TURNED), quality="lowpass=pixel"),
    "distorted": fs.Capture(look(turn=TURNED, lens=fs.BrownConrady(k1=-0.2, k2=0.02, p1=0.01))),
    "fisheye": fs.Capture(look(focal=16.0, turn=TURNED, lens=fs.Fisheye())),
    "wide fisheye": fs.Capture(look(focal=9.0, lens=fs.Fisheye(k1=0.05))),
    "panorama": fs.Capture(look(focal=SIZE[0] / (2 * math.pi), near=0.5, far=3.0, lens=fs.Equirectangular())),
    "parallel": fs.Capture(look(focal=20.0, turn=TURNED, lens=fs.Orthographic())),
    "exposure": fs.Capture(
        look(), motion=fs.Motion(lambda t: rigid_matrix((0, 0, 0), (1, 0, t, 0))),
        shutter=fs.Shutter(exposure_time=0.4, sub_poses=3),
    ),
    "groups": fs.Capture(
        look(turn=TURNED), motion=fs.Motion(groups={3: lambda t: rigid_matrix((3, 2, 1), (1, 1, 0, 0))})
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def reference():
    return fs.Renderer("reference")


@pytest.mark.parametrize("name", CAPTURES)
def test_views_are_drawn_of_what_they_see(stores, reference, name):
    kinds = ["thick"] if name in ("pinhole", "off-centre", "fisheye") else []
    for kind in ["disks", *kinds]:
        store, capture = stores[kind], CAPTURES[name].with_(outputs=("rgb", "splat_id", "label"))
        streamed = reference.upload(store)
        ours, whole = reference.render(streamed, capture), reference.render(store.cloud(), capture)
        for output in ours:
            assert np.array_equal(ours[output], whole[output]), output
        assert whole["rgb"].any()
        read, every = streamed.data.nodes, store.chunks
        assert 0 < read <= every
        if name in ("pinhole", "distorted"):
            assert read < 0.75 * every


def test_a_box_around_each_splat_is_seen_where_the_splat_is(stores, reference):
    """What is left out shows nowhere: splat by splat."""
    cloud = stores["thick"].cloud()
    for name in ("pinhole", "off-centre", "near and far", "distorted", "fisheye", "parallel"):
        capture = CAPTURES[name]
        features, view = prepare(cloud, capture)
        largest = np.maximum(cloud.scales.max(axis=1), cloud.thickness).astype(np.float64)

        def boxes(sigmas, largest=largest):
            return cloud.means - sigmas * largest[:, None], cloud.means + sigmas * largest[:, None]

        left_out = ~seen(view, features, boxes, largest)
        assert left_out.mean() > 0.2
        rest = np.flatnonzero(left_out)
        arrays = {n: getattr(cloud, n)[rest] for n in ("means", "quats", "opacities", "colors")}
        scales = np.column_stack([cloud.scales, cloud.thickness])[rest]
        unseen = fs.SplatCloud(scales=scales, **arrays)
        assert not reference.render(unseen, capture, outputs=("alpha",))["alpha"].any(), name


def test_a_needle_that_ewa_draws_into_a_wide_picture_is_seen(reference):
    focal = 1000 / math.tan(math.radians(80))
    camera = fs.Camera.pinhole(2000, 2, focal, focal, 1000, 1)
    capture = fs.Capture(camera, quality=fs.Quality(ellipsoid="ewa"), outputs=("alpha",))
    sigmas = np.float32([[1e-3, 1e-3, 0.26 / 4.8]])
    means = np.float32([[-7.3, 0, 1]])
    needle = fs.SplatCloud(means, [[1, 0, 0, 0]], sigmas, [0.99], colors=[[1, 1, 1]])
    assert reference.render(needle, capture)["alpha"].any()
    features, view = prepare(needle, capture)

    def boxes(count):
        return means.astype(np.float64) - count * sigmas, means.astype(np.float64) + count * sigmas

    assert seen(view, features, boxes, sigmas.max(axis=1).astype(np.float64)).all()
    exact, _ = prepare(needle, capture.with_(quality=fs.Quality(ellipsoid="exact")))
    assert not seen(view, exact, boxes, sigmas.max(axis=1).astype(np.float64)).any()


def test_what_moves_into_the_picture_by_itself_is_read(tmp_path, reference):
    behind = random_splats(200, 6, depth=(-4, -2), scale=(0.05, 0.1), across=0.5).with_labels(3)
    store = made_store(tmp_path, behind, "behind")
    half_turn = rigid_matrix((0, 0, 0), (0, 0, 1, 0))
    capture = fs.Capture(look(), motion=fs.Motion(groups={3: lambda t: half_turn}))
    ours, whole = (reference.render(each, capture)["rgb"] for each in (store, store.cloud()))
    assert ours.any()
    assert np.array_equal(ours, whole)
    assert not reference.render(store, look())["rgb"].any()


def test_a_device_draws_stores_bit_for_bit(stores, tmp_path):
    renderer = fs.Renderer("opencl")
    for kind in ("disks", "sh"):
        store = stores[kind]
        poses = [np.eye(4), rigid_matrix((9, 0, 1), (1, 0, 0.3, 0))]
        for one in (store, fs.Store(fs.place_store(store, tmp_path / f"{kind}.fss", poses))):
            cloud, resident = one.cloud(), renderer.upload(one)
            cameras = [look(), look(turn=TURNED), look(at=(9, 0, 0)), look()]
            frames = renderer.render_views(resident, cameras)
            for camera, frame in zip(cameras, frames, strict=True):
                assert np.array_equal(frame["rgb"], renderer.render(cloud, camera)["rgb"])
            batch = renderer.render_batch(resident, cameras[:3])
            for number, camera in enumerate(cameras[:3]):
                assert np.array_equal(batch["rgb"][number], renderer.render(cloud, camera)["rgb"])


def test_what_cannot_be_fetched_ahead_is_told_by_the_picture_that_needs_it(stores, reference, monkeypatch):
    tried, told = [], []

    def fetch(self, selection):
        tried.append(selection)
        raise fs.DeviceError("no memory")

    monkeypatch.setattr(Streamed, "fetch", fetch)
    monkeypatch.setattr(threading, "excepthook", told.append)
    cameras = [look(), look(turn=TURNED)]
    frames = list(reference.render_views(stores["disks"], cameras))
    assert len(frames) == 2
    assert tried
    assert not told


def test_a_device_draws_splats_beside_stores_bit_for_bit(stores):
    renderer = fs.Renderer("opencl")
    beside = random_splats(200, 8, depth=(1.0, 2.0), scale=(0.02, 0.1), across=0.5)
    scene = fs.Scene([beside], look(), stores=(stores["disks"],))
    resident = renderer.upload(scene)
    for camera in (look(), look(turn=TURNED)):
        ours, whole = (renderer.render(each, camera)["rgb"] for each in (resident, scene.cloud()))
        assert np.array_equal(ours, whole)
    # in parts as large as the chunks of the store
    assert resident.data._cache._rows < 200


def test_a_device_keeps_the_chunks_that_it_was_sent(stores, tmp_path, monkeypatch):
    sent, put = [], chunks.OpenCLChunks._put
    monkeypatch.setattr(
        chunks.OpenCLChunks, "_put", lambda self, key, *rest: sent.append(key) or put(self, key, *rest)
    )
    renderer, store = fs.Renderer("opencl"), stores["disks"]
    resident, cameras = renderer.upload(store), [look(), look(turn=TURNED), look()]
    for camera in cameras:
        assert np.array_equal(
            renderer.render(resident, camera)["rgb"], renderer.render(store.cloud(), camera)["rgb"]
        )
    assert 0 < len(sent) == len(set(sent)) <= store.chunks
    # of a store of places the splats are there once
    sent.clear()
    placed = fs.Store(fs.place_store(store, tmp_path / "p.fss", [np.eye(4), rigid_matrix((0, 0, 0.5))]))
    renderer.render(renderer.upload(placed), look())
    assert len(sent) == len(set(sent)) <= store.chunks


def test_a_part_of_what_is_gathered_may_begin_within_a_chunk(stores):
    backend, scene = fs.Renderer("opencl").backend, Streamed([stores["disks"]])
    gathered = backend.chunk_cache(scene, scene.largest_chunk).gather(scene.chunks(scene.everything(), True))
    gathered.streamed = True
    found = np.empty(130, np.float32)
    cl.enqueue_copy(backend.queue, found, gathered.part("opacities", 70, 200))
    assert np.array_equal(found, stores["disks"].cloud().opacities[70:200])


def test_slots_that_cannot_become_more_keep_what_they_hold(stores, monkeypatch):
    """Even where copies take their time, and of two arrays only the first has room."""
    renderer, store = fs.Renderer("opencl"), stores["disks"]
    resident = renderer.upload(store)
    renderer.render(resident, look())
    cache, pool, asked = resident.data._cache, renderer.backend.pool, []
    fresh = pool.fresh

    def full(name, size):
        asked.append(name)
        if len(asked) == 2:
            raise fs.DeviceError("no memory")
        return fresh(name, size)

    def contents_of(name):
        found = np.empty(before[name].size, np.uint8)
        cl.enqueue_copy(renderer.backend.queue, found, cache._arrays[name])
        return found

    before = dict(cache._arrays)
    wanted = {name: contents_of(name) for name in before}
    held = cl.UserEvent(renderer.backend.context)
    cl.enqueue_barrier(cache._queue, wait_for=[held])
    threading.Timer(0.2, held.set_status, [cl.command_execution_status.COMPLETE]).start()
    with monkeypatch.context() as patch:
        patch.setattr(pool, "fresh", full)
        with pytest.raises(fs.DeviceError, match="no memory"):
            cache._grow(2 * cache._size)
    assert sum(buffer is not before[name] for name, buffer in cache._arrays.items()) == 1
    assert all(np.array_equal(contents_of(name), array) for name, array in wanted.items())


def test_a_device_without_room_for_a_view_is_sent_its_chunks_again(stores, monkeypatch):
    renderer, store = fs.Renderer("opencl"), stores["disks"]
    # two chunks fit, and no picture is put together as a whole
    monkeypatch.setattr(chunks, "_SHARE", renderer.backend.memory_budget // 10000)
    monkeypatch.setattr(chunks, "_WHOLE", renderer.backend.memory_budget // 10000)
    resident, outputs = renderer.upload(store), ("rgb", "splat_id")
    for camera in (look(), look(turn=TURNED)):
        ours, whole = (renderer.render(each, camera, outputs) for each in (resident, store.cloud()))
        for output in outputs:
            assert np.array_equal(ours[output], whole[output]), output
    cache, scene = resident.data._cache, resident.data.scene
    held = set(cache._slots)
    assert 0 < len(held) <= 2
    # what is drawn does not make room for what is fetched ahead
    cache.bring(scene.chunks(scene.everything(), True))
    assert set(cache._slots) == held
    # nor does one chunk that is fetched ahead for another
    every = scene.chunks(scene.everything(), True)
    cache._drawn = set()
    cache.bring(every[:2])
    cache.bring(every)
    assert set(cache._slots) == {chunk.key for chunk in every[:2]}


def before_the_wall(x=0.0):
    return fs.Camera.look_at(120, 90, 1.4, (x, 0, -1), (x, 0, 3))


def test_what_does_not_fit_at_once_is_drawn_in_bands_of_what_each_sees(stores, monkeypatch):
    store, drawn, most = stores["wall"], [], 5500
    cloud, plain, limited = store.cloud(), fs.Renderer("opencl"), fs.Renderer("opencl")

    def fits(self, resident, view):
        drawn.append(resident.count)
        return resident.count < most

    monkeypatch.setattr(OpenCLPipeline, "fits", fits)
    resident, outputs = limited.upload(store), ("rgb", "splat_id", "depth")
    sampled = fs.Capture(before_the_wall(), quality="samples=2", outputs=outputs)
    moved = fs.Capture(before_the_wall(x=0.1), outputs=outputs)
    for capture in (fs.Capture(before_the_wall(), outputs=outputs), sampled, moved):
        drawn.clear()
        ours, whole = limited.render(resident, capture), plain.render(cloud, capture)
        for output in outputs:
            assert np.array_equal(ours[output], whole[output]), output
        assert sum(count < most for count in drawn) >= 2
        assert ours.stats["visible"] >= whole.stats["visible"]
        assert set(ours.timings) == set(whole.timings)
    # the next view begins with the bands of the last, each asked for once
    drawn.clear()
    limited.render(resident, moved)
    assert max(drawn) < most
    # a band of a picture is cut as the whole
    frame = limited.render_band((5, 80), resident, moved)
    assert np.array_equal(frame["rgb"][5:80], plain.render(cloud, moved)["rgb"][5:80])
    # where all rows see all, cutting is of no use
    drawn.clear()
    fisheye, most = CAPTURES["fisheye"].with_(camera=before_the_wall()), 1
    fisheye = fisheye.with_(camera=replace(fisheye.camera, lens=fs.Fisheye()))
    assert np.array_equal(limited.render(resident, fisheye)["rgb"], plain.render(cloud, fisheye)["rgb"])
    assert len(drawn) == 1


def test_a_budget_of_memory_makes_bands(stores):
    store, camera = stores["wall"], before_the_wall()
    limited, plain = fs.Renderer("opencl", memory_budget=2 << 20), fs.Renderer("opencl")
    resident = limited.upload(store)
    ours = limited.render(resident, camera)
    assert np.array_equal(ours["rgb"], plain.render(store.cloud(), camera)["rgb"])
    assert len(resident.data._bands._cuts[0, 90]) > 2


def test_a_picture_and_the_chunks_that_stay_keep_to_the_budget(stores, monkeypatch):
    live, peak, store = weakref.WeakSet(), [0], stores["wall"]

    class Counted(workspace.DeviceBuffer):
        def __init__(self, *given, **words):
            super().__init__(*given, **words)
            live.add(self)
            peak[0] = max(peak[0], sum(buffer.size for buffer in live))

    monkeypatch.setattr(workspace, "DeviceBuffer", Counted)
    for budget in (2200 << 10, 3 << 20):
        peak[0], limited = 0, fs.Renderer("opencl", memory_budget=budget)
        resident = limited.upload(store)
        for frame in limited.render_views(resident, [before_the_wall(x=0.05 * k) for k in range(5)]):
            assert frame["rgb"].any()
        assert 0.5 * budget < peak[0] <= budget
        cache = resident.data._cache
        assert 0 < cache.memory_bytes <= cache.reserved_bytes <= budget // 4
        # room is left for all that the cache may come to take, whatever it holds yet
        empty = limited.backend.chunk_cache(resident.data.scene, cache._rows)
        gathered = empty.gather(resident.data.scene.chunks(resident.data.scene.everything(), True))
        assert gathered.bytes_for(["means"])[0] == cache.reserved_bytes + 12 * len(store)
        assert empty.memory_bytes == 0
        del limited, resident, frame, cache, empty, gathered
        gc.collect()


def test_bands_that_fitted_together_are_drawn_together():
    made = bands.Bands()
    whole = SimpleNamespace(rows=(0, 64), count=64)
    whole.within = lambda first, end: SimpleNamespace(
        rows=(first, end), count=end - first, within=whole.within,
        halves=[] if end - first < 2 else [whole.within(first, (first + end) // 2),
                                           whole.within((first + end) // 2, end)],
    )  # fmt: skip
    assert [band.rows for band in made.cut(whole, lambda band: band.count <= 20)] == [
        (0, 16), (16, 32), (32, 48), (48, 64)
    ]  # fmt: skip
    assert len(list(made.cut(whole, lambda band: band.count <= 20))) == 4
    assert len(list(made.cut(whole, lambda band: band.count <= 8))) == 8
    assert len(list(made.cut(whole, lambda band: True))) == 8
    made._most = 33
    list(made.cut(whole, lambda band: True))
    assert made._cuts == {(0, 64): [0, 32, 64]}


def test_what_is_pickled_of_a_store_is_its_path_and_of_its_cloud_the_splats(stores):
    store, cloud = stores["thick"], stores["thick"].cloud()
    assert pickle.loads(pickle.dumps(store)).identity == store.identity
    for again in (pickle.loads(pickle.dumps(cloud)), copy.deepcopy(cloud)):
        assert type(again) is fs.SplatCloud
        assert np.array_equal(again.means, cloud.means)
        assert (again.ellipsoids, again.footprint) == (cloud.ellipsoids, cloud.footprint)
    scene = fs.Scene(stores=(store,), camera=look())
    assert len(pickle.loads(pickle.dumps(scene)).splats) == COUNT


def test_nothing_is_transferred_for_the_same_part(stores, reference, monkeypatch):
    uploads = []
    upload = reference.backend.upload
    monkeypatch.setattr(
        reference.backend, "upload", lambda cloud: uploads.append(len(cloud)) or upload(cloud)
    )
    resident = reference.upload(stores["disks"])
    assert uploads == []
    assert len(resident) == COUNT
    for _ in range(2):
        reference.render(resident, look())
    assert len(uploads) == 1
    assert uploads[0] < COUNT


def test_scenes_hold_stores_beside_markers_and_clouds(stores, reference, tmp_path):
    marker = fs.marker("apriltag:36h11:5", size=0.4, mixture="exact")
    placed = fs.scenes.PlacedMarker(marker, rigid_matrix((0, 0, 1.5)))
    other = random_splats(50, 8, depth=(1.0, 2.0), scale=(0.02, 0.1), across=0.5)
    far = fs.SplatCloud(
        other.means, other.quats, other.scales, other.opacities, colors=other.colors, origin=(0.25, 0, 0)
    )
    scene = fs.Scene([far], look(), (placed,), stores=(stores["sh"],))
    ours = reference.render(scene, outputs=("rgb", "label", "splat_id"))
    whole = reference.render(scene.cloud(), scene.camera, outputs=("rgb", "label", "splat_id"))
    for output in ours:
        assert np.array_equal(ours[output], whole[output]), output
    assert (ours["label"] == 1).any()
    # behind the scene there is nothing but what every picture has
    away = look(at=(0, 0, 50))
    assert len(np.unique(reference.render(scene, away)["rgb"])) == 1
    scene.save(tmp_path / "scene.toml")
    again = fs.Scene.load(tmp_path / "scene.toml")
    assert again.stores[0].identity == stores["sh"].identity
    assert len(again.clouds) == 1
    assert "store" in str(again.summary())
    text = (tmp_path / "scene.toml").read_text().replace("[[splats]]", "[[splats]]\nscale = 2.0")
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(fs.InputError, match="store place"):
        fs.Scene.load(tmp_path / "scene.toml")


def test_stores_with_origins_of_their_own_stand_where_they_were_built(tmp_path, reference):
    ahead = [random_splats(300, seed, depth=(1, 4), scale=(0.01, 0.1), across=0.8) for seed in (11, 12)]
    given = {name: getattr(ahead[1], name) for name in ("quats", "scales", "opacities", "colors")}
    moved = fs.SplatCloud(ahead[1].means - np.float32([8, 0, 0]), origin=(8.0, 0, 0), **given)
    stores = (made_store(tmp_path, ahead[0], "here"), made_store(tmp_path, moved, "there"))
    assert stores[1].origin.tolist() == [8, 0, 0]
    scene = fs.Scene(stores=stores, camera=look())
    ours = reference.render(scene, outputs=("rgb", "splat_id"))
    whole = reference.render(scene.cloud(), scene.camera, outputs=("rgb", "splat_id"))
    for output in ours:
        assert np.array_equal(ours[output], whole[output]), output
    assert ours["splat_id"].max() >= len(stores[0])
    apart = reference.render(fs.Scene([ahead[0], moved], look()), outputs=("rgb",))
    assert ours["rgb"] == pytest.approx(apart["rgb"], abs=1e-4)


def test_a_scene_has_no_more_splats_than_indices(stores, monkeypatch):
    monkeypatch.setattr(streamed, "MOST_SPLATS", 2 * COUNT - 1)
    with pytest.raises(fs.InputError, match="6,000 splats are too many"):
        Streamed([stores["disks"], stores["thick"]])
    monkeypatch.setattr(plan, "MOST_SPLATS", COUNT - 1)
    with pytest.raises(fs.InputError, match="3,000 splats are too many for a store"):
        plan.plan_of([source_of(splats(1), stores["disks"].path, "test")])


def test_planes_of_stores_are_always_whole(tmp_path, reference):
    marker = fs.marker("apriltag:36h11:5", size=0.4, mixture="fitted").cloud.transformed(
        rigid_matrix((0, 0, 2))
    )
    cloud = fs.SplatCloud.concatenate([marker, random_splats(500, 4, depth=(1.5, 4), scale=(0.01, 0.05))])
    store = made_store(tmp_path, cloud, "tag")
    near = look(5, at=(0.19, 0.19, 1.0))
    ours, whole = (reference.render(each, near)["rgb"] for each in (store, store.cloud()))
    assert np.array_equal(ours, whole)
    selection = Streamed([store]).select(
        [prepare(store, fs.Capture(look(at=(0, 0, 90))))[1]], prepare(store, fs.Capture(near))[0]
    )
    part = Streamed([store]).part(selection)
    assert len(part) == len(marker)
    assert Streamed([store]).ids(selection).tolist() == list(range(len(store) - len(marker), len(store)))


def test_a_flight_over_a_store_goes_on_by_its_content(stores, tmp_path):
    from fidsplat.flights import Flight

    path = fs.Trajectory([0.0, 1.0], [np.eye(4), rigid_matrix((0, 0, 1))])

    def key(store):
        return Flight(fs.Scene(stores=(store,), camera=look()), path, [0.0, 1.0], fs.Capture(look())).key(
            "device"
        )

    other = tmp_path / "other.fss"
    other.mkdir()
    for name, content in contents(stores["disks"].path).items():
        (other / name).write_bytes(content)
    assert key(fs.Store(other)) == key(stores["disks"]) != key(stores["sh"])
