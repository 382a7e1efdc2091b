"""Levels of detail: selection, measured errors, and the city for tests."""

import json
import math
import sys

import numpy as np
import pytest
from test_store_rendering import splats

import fidsplat as fs
from fidsplat.accuracy.candidates import Choice
from fidsplat.accuracy.candidates import load as load_candidates
from fidsplat.accuracy.detail_errors import SIZES, cameras_around, errors_of, measure_detail
from fidsplat.accuracy.error import reference_image
from fidsplat.backends.prepare import prepare
from fidsplat.cli import main
from fidsplat.store import build_plan
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.detail_errors import (
    MARGIN,
    DetailErrors,
    allowed_cell_size,
    load_detail_errors,
    save_detail_errors,
)
from fidsplat.store.sources import sample, splats_of
from fidsplat.streaming.frustum_culling import projected_sizes
from fidsplat.streaming.level_of_detail import select
from fidsplat.vision import read_back
from fidsplat.worlds.city import PITCH, City, flight

QUALITY = fs.Quality(lowpass="pixel", alpha_cutoff=1e-8)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_plan, "_MIN_MEMORY", 0)
        city = City(6000, houses=2)
        return fs.Store(fs.build_store([city.source], tmp_path_factory.mktemp("city") / "c.fss", chunk=128))


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("opencl")


def camera_at(away, size=(48, 32)):
    middle = np.array([PITCH, 0, PITCH])
    return fs.Camera.look_at(*size, 1.0, middle + away * np.array([0.6, -0.5, 0.6]), middle)


def selected_nodes(store, camera, limits):
    splats = ChunkedSplats([store])
    features, view = prepare(splats, fs.Capture(camera, quality=QUALITY))
    return select(splats, [view], features, limits).nodes[0], view


@pytest.mark.parametrize("limit", [0.05, 0.3, 1.0, 4.0])
@pytest.mark.parametrize("away", [20.0, 200.0, 2000.0])
def test_nodes_cover_every_chunk_once_and_none_that_is_too_near(store, limit, away):
    numbers, view = selected_nodes(store, camera_at(away), limit)
    nodes = store.nodes
    covered: list[int] = []
    for number in numbers:
        stack = [number]
        while stack:
            here = stack.pop()
            children = np.flatnonzero(nodes["parent"] == here)
            stack.extend(children.tolist())
            if nodes["level"][here] == 0:
                covered.append(here)
        if nodes["level"][number]:
            depth = (nodes["low"][number] + nodes["high"][number]) / 2 @ view.rotation[2] + view.translation[
                2
            ]
            # the middle lies no nearer than the nearest point, by which it was selected_nodes
            assert nodes["size"][number] * view.focal_x / depth <= limit
    assert len(covered) == len(set(covered))
    if away >= 200:  # all of the city is in the image
        assert sorted(covered) == np.flatnonzero(nodes["level"] == 0).tolist()
    assert list(numbers) == sorted(numbers)


def test_children_of_a_selected_node_are_not_selected(store):
    # only cells of the first level are too large
    limits = (0.0, 1e-9, *[1e9] * (store.levels - 1))
    numbers, _ = selected_nodes(store, camera_at(200.0), (limits,))
    assert store.levels > 1
    assert store.nodes["level"][list(numbers)].tolist() == [store.levels]


def test_sizes_of_cells_near_the_poles_of_a_panorama(store):
    camera = fs.Camera.pinhole(80, 40, 80 / math.tau, 80 / math.tau, 40, 20, lens=fs.Equirectangular())
    _, view = prepare(store, fs.Capture(camera))
    corners = np.array([[0.1, -5.0, 0.0], [5.0, 0.1, 0.0], [-1.0, -5.0, -1.0]])
    high = corners + np.array([[0.01], [0.01], [2.0]])
    above, beside, around = projected_sizes(view, lambda sigmas: (corners, high), np.full(3, 0.05))
    # by longitude
    assert above > 0.9 * 80 / math.tau * 0.05 / 0.11
    assert beside < 0.2
    assert around == math.inf


def test_cells_of_a_distorted_lens_have_the_sizes_of_a_pinhole(store):
    """0.05 m on the axis at 5 m, and a box next to the camera's plane."""
    corners = np.array([[-0.1, -0.1, 5.0], [3.0, -0.1, 4.0]])
    high = corners + np.array([[0.2, 0.2, 1.0], [1.0, 0.2, 1.0]])
    results = []
    for own in (None, fs.BrownConrady(k1=-0.1)):
        camera = fs.Camera.pinhole(80, 60, 50.0, 50.0, 40.0, 30.0, lens=own)
        _, view = prepare(store, fs.Capture(camera))
        results.append(projected_sizes(view, lambda sigmas: (corners, high), np.full(2, 0.05)))
    assert 0.5 <= results[0][0] < 0.5001
    assert np.array_equal(*results)


def test_fewer_splats_are_selected_further_away(store):
    counts = [
        sum(store.counts(np.array(selected_nodes(store, camera_at(distance), 0.5)[0])))
        for distance in (60, 600, 6000)
    ]
    assert len(store) >= counts[0] > counts[1] > counts[2]


def test_errors_grow_with_cell_size_and_are_saved(store, renderer):
    errors, *coarser = measure_detail(store, renderer, views=4 * store.levels)
    assert [one.level for one in (errors, *coarser)] == list(range(1, store.levels + 1))
    met = [
        (size, error) for size, error in zip(errors.sizes, errors.errors, strict=True) if error is not None
    ]
    assert errors.sizes == SIZES
    assert len(met) >= 4
    assert met[-1][1] > 0.02 > 1.5 * met[0][1]
    again = fs.Store(store.path)
    assert again.detail_errors == [errors, *coarser]
    allowed = MARGIN * met[0][1] + 1e-9
    limits = again.cell_sizes(QUALITY.with_(detail_error=allowed))
    assert limits[0] == 0.0
    assert limits[1] >= met[0][0]
    assert set(again.cell_sizes(QUALITY.with_(detail_error=1e-9))) == {0.0}
    loose, tight = QUALITY.with_(detail_error=0.3), QUALITY.with_(detail_error=allowed)
    assert ChunkedSplats([again]).cell_sizes(loose, tight) == (limits,)
    assert ChunkedSplats([again]).cell_sizes(QUALITY) == 0.0
    with pytest.raises(fs.InputError, match=r"store measure .* --lowpass none"):
        again.cell_sizes(fs.Quality(lowpass="none", detail_error=0.1))


@pytest.mark.parametrize("device", ["opencl", "warp:cpu"])
def test_frames_keep_the_allowed_error(store, renderer, device):
    measure_detail(store, renderer, views=4 * store.levels)
    renderer = fs.Renderer(device)
    resident = renderer.upload(fs.Store(store.path))
    for distance in (300.0, 1500.0):
        camera = camera_at(distance)
        exact = renderer.render(resident, camera, quality=QUALITY)
        for error in (0.01, 0.05):
            frame = renderer.render(resident, camera, quality=QUALITY.with_(detail_error=error))
            assert np.abs(frame["rgb"] - exact["rgb"]).max() <= error
        assert distance < 1000 or frame.stats["splats"] < exact.stats["splats"]
        ids = renderer.render(resident, camera, ("splat_id",), QUALITY.with_(detail_error=0.05))["splat_id"]
        assert ids.max() < len(store)


def test_a_frame_without_an_allowed_error_is_exact(store, renderer):
    resident, camera = renderer.upload(store), camera_at(2000.0)
    ours = renderer.render(resident, camera, quality=QUALITY)["rgb"]
    assert np.array_equal(ours, renderer.render(store.cloud(), camera, quality=QUALITY)["rgb"])


def measured(level, sizes, errors):
    return DetailErrors("pixel", level, sizes, errors, 3, "here", "today")


def test_the_strictest_view_decides_the_levels_of_a_batch(store, renderer):
    sizes, errors = (0.05, 0.5, 4.0), (1e-4, 1e-3, 1e-2)
    save_detail_errors(store.path, store.identity, [measured(level, sizes, errors) for level in range(1, 9)])
    resident, quality = renderer.upload(fs.Store(store.path)), QUALITY.with_(detail_error=0.05)

    def batch_of(*away, quality=quality):
        return renderer.render_batch(
            resident, [fs.Capture(camera_at(each, (160, 120)), quality=quality) for each in away]
        )

    def alone(away, quality=quality):
        return renderer.render(resident, camera_at(away, (160, 120)), quality=quality)

    far, near, exact = alone(700.0), alone(200.0), alone(700.0, QUALITY)
    assert far.stats["splats"] < near.stats["splats"] < exact.stats["splats"]
    same = batch_of(700.0, 700.0)
    assert same.stats["splats"] == far.stats["splats"]
    assert all(np.array_equal(image, far["rgb"]) for image in same["rgb"])
    assert not np.array_equal(far["rgb"], exact["rgb"])
    mixed = batch_of(700.0, 200.0)
    assert mixed.stats["splats"] >= near.stats["splats"]
    off = [np.abs(image - exact["rgb"]).max() for image in (mixed["rgb"][0], far["rgb"])]
    assert off[0] < off[1]


def test_unmeasured_sizes_are_not_used():
    one = measured(1, (0.1, 0.2, 0.4, 0.8), (None, 0.002, None, 0.1))
    assert allowed_cell_size([one], 1, 0.001) == 0.0
    assert allowed_cell_size([one], 1, MARGIN * 0.002) == 0.2
    assert allowed_cell_size([one], 1, 0.1) == 0.2
    assert allowed_cell_size([one], 1, MARGIN * 0.1) == 0.8
    # a larger error at a smaller size counts
    assert allowed_cell_size([measured(1, (0.1, 0.2), (0.5, 0.001))], 1, 0.01) == 0.0


def test_errors_of_adjacent_levels_count():
    errors = {1: (0.001, None), 2: (None, 0.003), 3: (0.1, 0.2), 5: (0.001, 0.002)}
    every = [measured(level, (0.1, 0.2), own) for level, own in errors.items()]
    assert [allowed_cell_size(every, level, 0.01) for level in range(7)] == [
        0.0,
        0.2,
        0.0,
        0.0,
        0.0,
        0.2,
        0.0,
    ]


def test_errors_of_other_content_are_ignored(tmp_path):
    details = [DetailErrors(name, 1, (0.1,), (0.2,), 1, "here", "today") for name in ("pixel", "screen")]
    save_detail_errors(tmp_path, "a", details)
    save_detail_errors(tmp_path, "a", [DetailErrors("pixel", 1, (0.3,), (None,), 1, "here", "today")])
    loaded = load_detail_errors(tmp_path, "a")
    assert [(one.lowpass, one.sizes) for one in loaded] == [("pixel", (0.3,)), ("screen", (0.1,))]
    assert load_detail_errors(tmp_path, "b") == []
    contents = (tmp_path / "detail.json").read_bytes()
    for damage in (
        b"{",
        b"[]",
        json.dumps({"identity": "a", "details": [{"sizes": 1, "errors": 2}]}).encode(),
        contents.replace(b"0.3", b"0.4"),
    ):
        (tmp_path / "detail.json").write_bytes(damage)
        with pytest.raises(fs.InputError, match="store measure"):
            load_detail_errors(tmp_path, "a")


def test_stores_without_detail_are_refused(store, renderer, tmp_path):
    placed = fs.Store(fs.place_store(store, tmp_path / "p.fss", [np.eye(4)]))
    with pytest.raises(fs.InputError, match=r"must contain splats, got .* instances of another store; pass"):
        measure_detail(placed, renderer)
    with pytest.raises(fs.InputError, match=r"views must be .* got 0"):
        measure_detail(store, renderer, views=0)
    with pytest.raises(fs.InputError, match="one or more of screen, pixel, none"):
        measure_detail(store, renderer, lowpass=("box",))
    flat = fs.Store(fs.build_store([City(300).source], tmp_path / "flat.fss", levels=False))
    with pytest.raises(fs.InputError, match="must have levels of detail"):
        measure_detail(flat, renderer)
    assert flat.cell_sizes(QUALITY.with_(detail_error=0.1)) == (0.0,)  # beside others it stays exact
    with pytest.raises(fs.InputError, match=r"detail_error must .* got 1"):
        fs.Quality(detail_error=1.0)


def test_measured_views_contain_all_sizes(store):
    focal = 160 / math.tan(math.radians(30))
    nodes = store.nodes
    edges = [
        np.median(nodes["size"][nodes["level"] == level]) for level in range(1, nodes["level"].max() + 1)
    ]
    middle = sum(store.bounds(0.0)) / 2
    distances = [np.linalg.norm(camera.position - middle) for camera in cameras_around(store, 5 * len(edges))]
    for first, edge in enumerate(edges):
        sizes = [edge * focal / distance for distance in distances[first :: len(edges)]]
        assert min(sizes) < 0.15
        assert max(sizes) > 0.4
    errors = errors_of(store, fs.Renderer("reference"), fs.Capture(camera_at(50.0, (8, 6))), [1e-6, 1e-5], 1)
    assert errors == [None, None]


def test_a_city_does_not_depend_on_how_it_is_read():
    city = City(150_000, houses=3, seed=4)
    source = city.source
    kinds = {"means": "<f4", "colors": "<f4", "quats": "<f4", "scales": "<f4", "opacities": "<f4"}
    whole, dropped = splats_of(source, (0, 150_000), np.zeros(3), kinds, -1)
    part, _ = splats_of(source, (65_000, 70_000), np.zeros(3), kinds, -1)
    assert dropped == {}
    for name, array in part.items():
        assert np.array_equal(array, whole[name][65_000:70_000]), name
    assert whole["means"].min() > -1e-3 - 24
    assert whole["means"][:, [0, 2]].max() < city.side + 1e-3
    assert (whole["means"][:, 1] <= 1e-3).all()
    assert len(sample([source])[0])
    for bad in ({"splats": 0}, {"splats": 10, "houses": 101}, {"splats": 10, "seed": -1}):
        with pytest.raises(fs.InputError, match="of a city must be"):
            City(**bad)
    camera, path = flight(city)
    assert camera.width == 1280
    assert path.times[-1] == 8.0


def test_a_city_too_small_for_levels_is_rendered_exactly(tmp_path, capsys):
    assert main(["store", "demo", "-o", str(tmp_path), "--splats", "50", "--houses", "1"]) == 0
    assert "50 splats in 1 chunk, in" in capsys.readouterr().out
    assert fs.Scene.load(tmp_path / "city.toml").capture.quality.detail_error == 0
    for options in (["--splats", "nan"], ["--splats", "inf"], ["--splats", "0.5"], ["--views", "-1"]):
        assert main(["store", "demo", "-o", str(tmp_path / "none"), *options]) == 2
        assert options[0] in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_an_error_bound_allows_levels_of_detail(store, renderer):
    measure_detail(store, renderer, views=4 * store.levels)
    capture = fs.Capture(camera_at(1500.0), quality="lowpass=pixel")
    quality = fs.quality_within(error=0.08, scene=fs.Store(store.path), capture=capture, device=renderer)
    assert quality.detail_error == 0.04
    exact = reference_image(renderer, store, capture.with_(quality=quality))
    frame = renderer.render(fs.Store(store.path), capture, quality=quality)
    assert np.abs(frame["rgb"] - exact).max() <= 0.08
    assert frame.stats["splats"] < len(store)
    assert np.array_equal(exact, reference_image(renderer, store.cloud(), capture))


def test_an_error_that_levels_of_detail_exceed_is_met_without_them(store, renderer):
    """Measured errors hold for measured views; here they are wrong for all."""
    copy = fs.Store(store.path)
    copy.detail_errors = [measured(level, (4.0,), (1e-9,)) for level in range(1, copy.levels + 1)]
    capture = fs.Capture(camera_at(1500.0), quality="lowpass=pixel")
    quality = fs.quality_within(error=1e-3, scene=copy, capture=capture, device=renderer)
    assert quality.detail_error == 0
    frame = renderer.render(copy, capture, quality=quality)
    exact = reference_image(renderer, store, capture.with_(quality=quality))
    assert np.abs(frame["rgb"] - exact).max() <= 1e-3


def test_a_time_bound_allows_levels_of_detail(store, renderer, monkeypatch, tmp_path):
    """Allowed errors rise until they exceed the best one found."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    measure_detail(store, renderer, views=4 * store.levels)
    tried, errors = [], {0.0: None, 1 / 255: 0.2, 4 / 255: 0.03, 16 / 255: 0.1, 0.5: 0.0}

    def found(search, error, ms):
        base = search.measurement.base
        tried.append(base.detail_error)
        if errors[base.detail_error] is None:
            raise fs.InputError("ms must be at least 2 in 1 ms")
        candidate = load_candidates(renderer.device.kind)[0]
        own = candidate.quality(base)
        return Choice(own, errors[base.detail_error], 1.0, 1.0, "measured", "here", candidate.settings)

    monkeypatch.setattr(sys.modules["fidsplat.accuracy.quality_within"], "_search", found)
    requested = {"scene": store, "capture": camera_at(1500.0), "device": renderer}
    requested["capture"] = fs.Capture(requested["capture"], quality="lowpass=pixel")
    for _ in range(2):  # the second is kept
        assert fs.quality_within(ms=1.0, **requested).detail_error == 4 / 255
    assert tried == [0.0, 1 / 255, 4 / 255]
    errors[1 / 255] = errors[4 / 255] = errors[16 / 255] = errors[0.5] = None
    with pytest.raises(fs.InputError, match="in 1 ms"):
        fs.quality_within(ms=2.0, **requested)


def test_a_cloud_in_memory_is_exact(renderer):
    cloud = splats(7)
    camera = fs.Camera.look_at(48, 32, 1.0, (0, 0, 0), (0, 0, 1))
    exact = renderer.render(cloud, camera, quality=QUALITY)["rgb"]
    assert np.array_equal(
        exact, renderer.render(cloud, camera, quality=QUALITY.with_(detail_error=0.5))["rgb"]
    )


def test_markers_on_the_walls_of_a_city_are_read(tmp_path, renderer, capsys):
    words = ["store", "demo", "-o", str(tmp_path), "--splats", "20000", "--houses", "1", "--views", "0"]
    assert main([*words, "--markers", "6"]) == 0
    scene = fs.Scene.load(tmp_path / "city.toml")
    assert len(scene.markers) == 6
    for number in (0, 3, 5):
        pose = scene.markers[number].pose
        assert pose[1, 3] == pytest.approx(-1.7)
        camera = fs.Camera.look_at(160, 120, 1.0, pose[:3, 3] - 3.0 * pose[:3, 2], pose[:3, 3])
        reading = read_back(renderer.render(scene, fs.Capture(camera)), scene, camera).readings[number]
        assert reading.detection is not None, number
        assert reading.position_error < 0.01
    assert main([*words, "--markers", "1001"]) == 2
    assert "--markers must be a whole number from 0 to 1000, got 1001" in capsys.readouterr().err
