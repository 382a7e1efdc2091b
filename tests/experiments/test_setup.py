"""The paper's set-up: markers, planes, viewpoints, protocols."""

import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.experiments.setup import (
    CATEGORIES,
    COLLECTIONS,
    MAX_TEST_TILT,
    PLANE,
    PROTOCOLS,
    chosen_categories,
    novel_cameras,
    training_cameras,
)
from fidsplat.markers import marker

VERSIONS = {"small": 2, "medium": 5, "large": 10, "huge": 22}
LENGTHS = {"small": 20, "medium": 100, "large": 250, "huge": 1000}


def tilt_of(camera: fs.Camera) -> float:
    return math.degrees(math.acos(-camera.position[2] / np.linalg.norm(camera.position)))


def test_markers_are_those_of_the_paper():
    assert [CATEGORIES["apriltag"].spec(i) for i in range(5)] == [f"apriltag:36h11:{i}" for i in range(5)]
    for name, version in VERSIONS.items():
        sign = marker(CATEGORIES[name].spec(3))
        assert sign.family == f"v{version}-L"
        assert sign.bits.shape[0] == 17 + 4 * version
        assert len(sign.payload) == LENGTHS[name]
        # the smallest version that holds such a text, as the paper's is
        assert marker(f"qr:{sign.payload}").family == sign.family


def test_texts_are_seeded_and_differ():
    texts = {CATEGORIES["small"].spec(i, seed) for i in range(5) for seed in (0, 1)}
    assert len(texts) == 10
    assert CATEGORIES["huge"].spec(2) == CATEGORIES["huge"].spec(2)


def test_protocols_give_the_plane_and_the_module_that_they_promise():
    for cells in (10, 33, 113):
        assert PROTOCOLS["fixed-plane"].module(cells) * cells == pytest.approx(PLANE)
        protocol = PROTOCOLS["fixed-module"]
        module = protocol.module(cells)
        pixels = protocol.camera(0.0).project([[0, 0, 0], [module, 0, 0]])
        assert pixels[1, 0] - pixels[0, 0] == pytest.approx(8.0)


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize("tilt", [0.0, 37.2, 89.8])
def test_the_camera_tilts_about_the_rows_at_a_fixed_distance(name, tilt):
    protocol = PROTOCOLS[name]
    camera = protocol.camera(tilt)
    assert np.linalg.norm(camera.position) == pytest.approx(protocol.distance)
    assert tilt_of(camera) == pytest.approx(tilt)
    half = protocol.module(113) * 113 / 2
    corners = camera.project([[x, y, 0] for x in (-half, half) for y in (-half, half)])
    assert corners.min() >= 0
    assert corners.max() <= protocol.pixels
    assert corners[0, 1] == pytest.approx(corners[2, 1])  # edges along the rows stay along the rows


def test_collections_grow_and_see_the_whole_plane():
    sizes = [len(training_cameras(n)) for n in COLLECTIONS]
    assert sizes == [3, 5, 9, 17]
    spread = [max(map(tilt_of, training_cameras(n))) for n in COLLECTIONS]
    assert spread == sorted(spread)
    assert spread[0] < 20
    every = training_cameras(17)
    for few in COLLECTIONS:
        same = zip(training_cameras(few), every, strict=False)
        assert all(np.array_equal(a.world_to_camera, b.world_to_camera) for a, b in same)
    with pytest.raises(fs.InputError, match="must be 3, 5, 9 or 17, got"):
        training_cameras(4)


def test_novel_views_are_seeded_random_and_see_the_whole_plane():
    cameras = novel_cameras(CATEGORIES["large"], 2)
    again = novel_cameras(CATEGORIES["large"], 2)
    other = novel_cameras(CATEGORIES["large"], 3)
    assert len(cameras) == 20
    assert all(
        np.array_equal(a.world_to_camera, b.world_to_camera) for a, b in zip(cameras, again, strict=True)
    )
    another_seed = novel_cameras(CATEGORIES["large"], 2, seed=1)
    another_category = novel_cameras(CATEGORIES["huge"], 2)
    for cameras_of_another in (other, another_seed, another_category):
        assert not np.allclose(cameras[0].position, cameras_of_another[0].position)
    tilts = [tilt_of(camera) for camera in cameras]
    assert max(tilts) <= MAX_TEST_TILT
    assert max(tilts) - min(tilts) > 25
    corners = [[x, y, 0] for x in (-1, 1) for y in (-1, 1)]
    for camera in [*cameras, *training_cameras()]:
        pixels = camera.project(corners)
        assert pixels.min() >= 0
        assert pixels.max() <= 800


def test_unknown_categories_are_named():
    assert [c.name for c in chosen_categories(("huge", "apriltag"))] == ["apriltag", "huge"]
    with pytest.raises(fs.InputError, match="unknown category 'tiny'; known: apriltag, small"):
        chosen_categories(("tiny",))
