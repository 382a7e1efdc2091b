"""Rendering stores: culled chunks are not read, and frames are bit-identical to those in memory."""

import copy
import math
import pickle
import threading

import numpy as np
import pytest
from small_stores import contents
from store_views import COUNT, SIZE, TURNED, build_small_store, build_small_stores, look, splats

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.store import build_plan, chunked_splats
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.sources import source_of
from fidsplat.streaming.frustum_culling import in_frustum
from fidsplat.streaming.level_of_detail import select

CAPTURES = {
    "pinhole": fs.Capture(look(turn=TURNED)),
    "off-centre": fs.Capture(look(center=(-30.0, 50.0), turn=TURNED)),
    "aside": fs.Capture(look(50, turn=TURNED, at=(1.5, -0.8, -2.0), aspect=1.4, center=(12.0, 20.0))),
    "fisheye, aside": fs.Capture(
        look(focal=20.0, turn=TURNED, at=(-1.0, 2.5, 1.5), aspect=0.7, lens=fs.Fisheye(k1=0.02))
    ),
    "near and far": fs.Capture(look(90, near=0.5, far=2.0)),
    "no low-pass": fs.Capture(look(at=(2, 1, -1), turn=TURNED), quality="lowpass=none"),
    "high cut-off": fs.Capture(look(turn=TURNED), quality="gsplat"),
    "samples": fs.Capture(look(), quality="samples=2"),
    "pixel": fs.Capture(look(turn=TURNED), quality="lowpass=pixel"),
    "pixel, all": fs.Capture(look(turn=TURNED), quality="lowpass=pixel,alpha_cutoff=1e-8,samples=2"),
    "pixel, fisheye": fs.Capture(look(focal=16.0, lens=fs.Fisheye(k1=0.02)), quality="lowpass=pixel"),
    "pixel, folded": fs.Capture(look(focal=16.0, lens=fs.Fisheye(k1=-0.2)), quality="lowpass=pixel"),
    "pixel, parallel": fs.Capture(look(focal=20.0, lens=fs.Orthographic()), quality="lowpass=pixel"),
    "pixel, distorted": fs.Capture(look(lens=fs.BrownConrady(k1=-0.2)), quality="lowpass=pixel"),
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
def stores(tmp_path_factory):
    return build_small_stores(tmp_path_factory.mktemp("stores"))


@pytest.fixture(scope="module")
def reference():
    return fs.Renderer("reference")


@pytest.mark.sweep
@pytest.mark.parametrize("name", CAPTURES)
def test_views_read_visible_chunks_only(stores, reference, name):
    kinds = ["thick"] if name in ("pinhole", "off-centre", "fisheye", "aside") else []
    kinds += ["sh"] if "aside" in name else []  # whose colours follow the position of the camera
    for kind in ["disks", *kinds]:
        store, capture = stores[kind], CAPTURES[name].with_(outputs=("rgb", "splat_id", "label"))
        resident = reference.upload(store)
        ours, full_frame = reference.render(resident, capture), reference.render(store.cloud(), capture)
        for output in ours:
            assert np.array_equal(ours[output], full_frame[output]), output
        assert full_frame["rgb"].any()
        read, every = resident.data.node_count, store.chunks
        assert 0 < read <= every
        if name in ("pinhole", "distorted", "pixel", "aside"):
            assert read < 0.75 * every


def test_boxes_outside_the_frustum_do_not_contribute(stores, reference):
    """Splats whose boxes are culled change no pixel."""
    cloud = stores["thick"].cloud()
    for name in ("pinhole", "off-centre", "near and far", "distorted", "fisheye", "parallel", "pixel"):
        capture = CAPTURES[name]
        features, view = prepare(cloud, capture)
        largest = np.maximum(cloud.scales.max(axis=1), cloud.thickness).astype(np.float64)

        def boxes(sigmas, largest=largest):
            return cloud.means - sigmas * largest[:, None], cloud.means + sigmas * largest[:, None]

        left_out = ~in_frustum(view, features, boxes, largest)
        assert left_out.mean() > 0.2
        rest = np.flatnonzero(left_out)
        arrays = {n: getattr(cloud, n)[rest] for n in ("means", "quats", "opacities", "colors")}
        scales = np.column_stack([cloud.scales, cloud.thickness])[rest]
        unseen = fs.SplatCloud(scales=scales, **arrays)
        assert not reference.render(unseen, capture, outputs=("alpha",))["alpha"].any(), name


WIDENED = {
    "pinhole": (look(4.0), (0.16, 0.08)),
    "fisheye": (look(focal=570.0, lens=fs.Fisheye(k1=0.02)), (0.05, 0.04)),
}


@pytest.mark.parametrize("name", WIDENED)
def test_splats_that_the_low_pass_pixel_widens_are_in_the_frustum(reference, name):
    """Disks next to the image that are nearly edge-on, their near ends further inwards."""
    camera, most = WIDENED[name]
    generator, count = np.random.default_rng(4), 1500
    outward = np.column_stack([generator.uniform(-0.8, 0.8, count), np.zeros((count, 2))])
    outward[:, 1] = generator.uniform(-0.2, 0.2, count)
    towards = outward + np.array([0.0, 0.0, 1.0])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    means = (towards * generator.uniform(1.0, 3.0, (count, 1))).astype(np.float32)
    along = towards + 10.0 ** generator.uniform(-3, -1.5, (count, 1)) * outward
    beside = np.cross(along, np.array([0, 1, 0]) + 0.3 * generator.normal(size=(count, 3)))
    along, beside = (axis / np.linalg.norm(axis, axis=1, keepdims=True) for axis in (along, beside))
    turns = np.stack([along, beside, np.cross(along, beside)], axis=2)
    quats = [matrix_to_quaternion(quaternion) for quaternion in turns]
    sizes = np.linalg.norm(means, axis=1)[:, None] * generator.uniform((0, 0), most, (count, 2))
    cloud = fs.SplatCloud(means, quats, sizes, np.full(count, 0.99), colors=np.ones((count, 3)))
    quality = fs.Quality(lowpass="pixel", alpha_cutoff=1e-8)
    capture = fs.Capture(camera, quality=quality, outputs=("alpha",))
    features, view = prepare(cloud, capture)

    def boxes(sigmas):
        around = sigmas * np.hypot(along * sizes[:, :1], beside * sizes[:, 1:])
        return means - around, means + around

    shown = in_frustum(view, features, boxes, sizes.max(axis=1))
    assert 0.05 < shown.mean() < 0.95

    def alpha(chosen):
        arrays = {n: getattr(cloud, n)[chosen] for n in ("means", "quats", "scales", "opacities", "colors")}
        return reference.render(fs.SplatCloud(**arrays), capture)["alpha"]

    assert not alpha(~shown).any()
    assert alpha(shown).any()


@pytest.mark.parametrize("name", ["pixel, parallel", "pixel, distorted"])
def test_unbounded_footprints_are_culled_by_depth_only(name):
    cloud = fs.SplatCloud([(50.0, 0, 1)], [(1, 0, 0, 0)], [(0.1, 0.1)], [0.9], colors=[(1, 1, 1)])
    features, view = prepare(cloud, CAPTURES[name])
    assert in_frustum(view, features, lambda sigmas: (cloud.means, cloud.means), np.array([0.1])).all()


@pytest.mark.parametrize("lens", [None, fs.Fisheye(k1=0.02), fs.BrownConrady(k1=-0.1)], ids=str)
def test_walls_next_to_the_camera_under_the_low_pass_pixel(tmp_path, lens):
    """A street from random positions, with walls edge-on."""
    generator, count = np.random.default_rng(9), 4000
    means = generator.uniform((-1, -1.5, -12), (1, 0.5, 12), (count, 3))
    means[:, 0] = np.sign(means[:, 0])  # to the left and right
    quats = np.tile((math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 0.0), (count, 1))
    sizes = generator.uniform(0.01, 0.06, (count, 2))
    street = fs.SplatCloud(
        means, quats, sizes, np.full(count, 0.7), colors=generator.uniform(0, 1, (count, 3))
    )
    store, renderer = build_small_store(tmp_path, street, "street"), fs.Renderer("opencl")
    whole, resident = renderer.upload(store.cloud()), renderer.upload(store)
    quality, read = fs.Quality(lowpass="pixel", alpha_cutoff=1e-8), []
    for number in range(12):
        at = (
            generator.choice([-1, 1]) * (1 - 10.0 ** generator.uniform(-4, 0)),
            -0.4,
            generator.uniform(-9, 9),
        )
        half = generator.uniform(-math.pi, math.pi) if number % 2 else generator.normal(0, 0.01)
        quaternion = (math.cos(half), 0.0, math.sin(half), 0.0)
        camera = look(turn=quaternion, at=at, lens=lens) if lens else look(turn=quaternion, at=at)
        ours, expected = (renderer.render(each, camera, quality=quality) for each in (resident, whole))
        assert np.array_equal(ours["rgb"], expected["rgb"])
        read.append(ours.stats["splats"])
    assert (min(read) < 0.6 * count) or isinstance(lens, fs.BrownConrady)


def test_a_needle_that_ewa_widens_is_in_the_frustum(reference):
    focal = 1000 / math.tan(math.radians(80))
    camera = fs.Camera.pinhole(2000, 2, focal, focal, 1000, 1)
    capture = fs.Capture(camera, quality=fs.Quality(ellipsoid="ewa"), outputs=("alpha",))
    sigmas = np.float32([[1e-3, 1e-3, 0.24 / 4.8]])
    means = np.float32([[-7.3, 0, 1]])
    needle = fs.SplatCloud(means, [[1, 0, 0, 0]], sigmas, [0.99], colors=[[1, 1, 1]])
    assert reference.render(needle, capture)["alpha"].any()
    features, view = prepare(needle, capture)

    def boxes(count):
        return means.astype(np.float64) - count * sigmas, means.astype(np.float64) + count * sigmas

    assert in_frustum(view, features, boxes, sigmas.max(axis=1).astype(np.float64)).all()
    exact, _ = prepare(needle, capture.with_(quality=fs.Quality(ellipsoid="exact")))
    assert not in_frustum(view, exact, boxes, sigmas.max(axis=1).astype(np.float64)).any()


def test_moving_groups_are_culled_at_their_poses(tmp_path, reference):
    behind = random_splats(200, 6, depth=(-4, -2), scale=(0.05, 0.1), across=0.5).with_labels(3)
    store = build_small_store(tmp_path, behind, "behind")
    half_turn = rigid_matrix((0, 0, 0), (0, 0, 1, 0))
    capture = fs.Capture(look(), motion=fs.Motion(groups={3: lambda t: half_turn}))
    ours, full_frame = (reference.render(each, capture)["rgb"] for each in (store, store.cloud()))
    assert ours.any()
    assert np.array_equal(ours, full_frame)
    assert not reference.render(store, look())["rgb"].any()


def test_stores_are_bit_identical_on_a_device(stores, tmp_path):
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


def test_a_failed_prefetch_is_ignored(stores, reference, monkeypatch):
    tried, reported = [], []

    def prefetch(self, selection):
        tried.append(selection)
        raise fs.DeviceError("no memory")

    monkeypatch.setattr(ChunkedSplats, "prefetch", prefetch)
    monkeypatch.setattr(threading, "excepthook", reported.append)
    cameras = [look(), look(turn=TURNED)]
    frames = list(reference.render_views(stores["disks"], cameras))
    assert len(frames) == 2
    assert tried
    assert not reported


def test_stores_with_splats_in_memory_are_bit_identical(stores):
    renderer = fs.Renderer("opencl")
    beside = random_splats(200, 8, depth=(1.0, 2.0), scale=(0.02, 0.1), across=0.5)
    scene = fs.Scene([beside], look(), stores=(stores["disks"],))
    resident = renderer.upload(scene)
    for camera in (look(), look(turn=TURNED)):
        ours, full_frame = (renderer.render(each, camera)["rgb"] for each in (resident, scene.cloud()))
        assert np.array_equal(ours, full_frame)
    # split into chunks of the size of the store's
    assert resident.data._cache._rows < 200


def test_stores_are_pickled_by_path_and_their_clouds_by_content(stores):
    store, cloud = stores["thick"], stores["thick"].cloud()
    assert pickle.loads(pickle.dumps(store)).identity == store.identity
    for again in (pickle.loads(pickle.dumps(cloud)), copy.deepcopy(cloud)):
        assert type(again) is fs.SplatCloud
        assert np.array_equal(again.means, cloud.means)
        assert (again.ellipsoids, again.footprint) == (cloud.ellipsoids, cloud.footprint)
    scene = fs.Scene(stores=(store,), camera=look())
    assert len(pickle.loads(pickle.dumps(scene)).splats) == COUNT


def test_the_same_selection_is_not_uploaded_again(stores, reference, monkeypatch):
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


def test_scenes_with_stores_markers_and_clouds(stores, reference, tmp_path):
    marker = fs.marker("apriltag:36h11:5", size=0.4, mixture="exact")
    placed = fs.scenes.PlacedMarker(marker, rigid_matrix((0, 0, 1.5)))
    other = random_splats(50, 8, depth=(1.0, 2.0), scale=(0.02, 0.1), across=0.5)
    far = fs.SplatCloud(
        other.means, other.quats, other.scales, other.opacities, colors=other.colors, origin=(0.25, 0, 0)
    )
    scene = fs.Scene([far], look(), (placed,), stores=(stores["sh"],))
    ours = reference.render(scene, outputs=("rgb", "label", "splat_id"))
    full_frame = reference.render(scene.cloud(), scene.camera, outputs=("rgb", "label", "splat_id"))
    for output in ours:
        assert np.array_equal(ours[output], full_frame[output]), output
    assert (ours["label"] == 1).any()
    # away from the scene only pinned chunks are read
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


def test_stores_with_different_origins(tmp_path, reference):
    ahead = [random_splats(300, seed, depth=(1, 4), scale=(0.01, 0.1), across=0.8) for seed in (11, 12)]
    arguments = {name: getattr(ahead[1], name) for name in ("quats", "scales", "opacities", "colors")}
    moved = fs.SplatCloud(ahead[1].means - np.float32([8, 0, 0]), origin=(8.0, 0, 0), **arguments)
    stores = (build_small_store(tmp_path, ahead[0], "here"), build_small_store(tmp_path, moved, "there"))
    assert stores[1].origin.tolist() == [8, 0, 0]
    scene = fs.Scene(stores=stores, camera=look())
    ours = reference.render(scene, outputs=("rgb", "splat_id"))
    full_frame = reference.render(scene.cloud(), scene.camera, outputs=("rgb", "splat_id"))
    for output in ours:
        assert np.array_equal(ours[output], full_frame[output]), output
    assert ours["splat_id"].max() >= len(stores[0])
    apart = reference.render(fs.Scene([ahead[0], moved], look()), outputs=("rgb",))
    assert ours["rgb"] == pytest.approx(apart["rgb"], abs=1e-4)


def test_too_many_splats_are_refused(stores, monkeypatch):
    monkeypatch.setattr(chunked_splats, "MAX_SPLATS", 2 * COUNT - 1)
    with pytest.raises(fs.InputError, match="at most 5,999 splats, got 6,000"):
        ChunkedSplats([stores["disks"], stores["thick"]])
    monkeypatch.setattr(build_plan, "MAX_SPLATS", COUNT - 1)
    with pytest.raises(fs.InputError, match="at most 2,999 splats, got 3,000"):
        build_plan.plan_build([source_of(splats(1), stores["disks"].path, "test")])


def test_coplanar_groups_of_stores_are_part_of_every_frame(tmp_path, reference):
    marker = fs.marker("apriltag:36h11:5", size=0.4, mixture="fitted").cloud.transformed(
        rigid_matrix((0, 0, 2))
    )
    cloud = fs.SplatCloud.concatenate([marker, random_splats(500, 4, depth=(1.5, 4), scale=(0.01, 0.05))])
    store = build_small_store(tmp_path, cloud, "tag")
    near = look(5, at=(0.19, 0.19, 1.0))
    ours, full_frame = (reference.render(each, near)["rgb"] for each in (store, store.cloud()))
    assert np.array_equal(ours, full_frame)
    selection = select(
        ChunkedSplats([store]),
        [prepare(store, fs.Capture(look(at=(0, 0, 90))))[1]],
        prepare(store, fs.Capture(near))[0],
    )
    part = ChunkedSplats([store]).load(selection)
    assert len(part) == len(marker)
    assert ChunkedSplats([store]).ids(selection).tolist() == list(range(len(store) - len(marker), len(store)))


def test_the_key_of_a_flight_is_the_content_of_its_store(stores, tmp_path):
    from fidsplat.render.flight import Flight

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
