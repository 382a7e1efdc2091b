"""The demo end to end on the best device that is here, and the checks that it rests on."""

import json

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments import demo
from fidsplat.experiments.demo import Sighting, run_captured
from fidsplat.images.files import read_image
from fidsplat.scenes import captured
from fidsplat.worlds.yard import demo_scene

pytestmark = pytest.mark.usefixtures("optimised")


@pytest.fixture(scope="module")
def scene():
    return demo_scene()


@pytest.fixture(scope="module")
def pictures():
    """Images that the demo has rendered, by the position of the camera."""
    return {}


@pytest.fixture(autouse=True)
def rendered_once(pictures, monkeypatch):
    """One frame of each view is timed, and none is rendered again for a second demo."""
    draw = demo._render

    def kept(renderer, resident, scene, camera, outputs):
        place = tuple(camera.position)
        if place not in pictures:
            pictures[place] = draw(renderer, resident, scene, camera, outputs)
        return pictures[place]

    monkeypatch.setattr(demo, "_FRAMES", 1)
    monkeypatch.setattr(demo, "_render", kept)


@pytest.fixture
def blob(tmp_path, monkeypatch):
    """A single splat replaces a captured scene, which would be downloaded."""
    cloud = fs.SplatCloud([[0, -1.6, 0]], [[1, 0, 0, 0]], [[0.1, 0.1]], [0.9], colors=[[1, 0, 0]])
    fs.save_splats(cloud, tmp_path / "blob.ply")
    for module in (demo, captured):
        monkeypatch.setattr(module, "fetch_scene", lambda *_: tmp_path / "blob.ply")


def test_the_demo_passes_and_writes_what_it_made(tmp_path, capsys, blob):
    folder = tmp_path / "made" / "demo"
    assert main(["demo", "--out", str(folder), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["passed"]
    assert 8_000 < result["background_splats"] < 12_000
    assert result == json.loads((folder / "demo.json").read_text())

    whole = [s for s in result["sightings"] if s["passed"] is not None]
    assert len(result["sightings"]) == 9 + 4
    assert len(whole) == 8 + 4
    assert result["captured"].startswith("Biker by PlayCanvas, MIT")
    for sighting in whole:
        assert sighting["found"]
        assert sighting["position_error_mm"] < 10 * sighting["distance_m"]
    (hidden,) = [s for s in result["sightings"] if s["passed"] is None]
    assert hidden["view"] == "hidden"
    assert 0.3 < hidden["visible"] < 0.9

    names = {path.name for path in folder.iterdir()}
    assert {path.rsplit("/", 1)[-1] for path in result["files"]} == names
    for view in ("frontal", "60-degrees", "hidden"):
        assert {f"{view}-{name}.png" for name in ("rgb", "depth", "normal", "label", "detection")} <= names
    assert read_image(folder / "contact-sheet.png").shape[1] > 1500

    loaded = fs.Scene.load(folder / "scene.toml")
    # a PLY file has no boxes: the markers' stand there as Gaussians
    more = sum(len(p.marker.gaussians) - len(p.marker.cloud) for p in loaded.markers)
    assert len(loaded.cloud()) + more == len(fs.load_ply(folder / "scene.ply"))
    assert {p.marker.spec for p in loaded.markers} | {"qr:fidsplat"} == set(result["marker_splats"])
    # the scene file gives the image that the demo saved
    assert main(["render", str(folder / "scene.toml"), "-o", str(folder / "again.png")]) == 0
    assert np.array_equal(read_image(folder / "again.png"), read_image(folder / "frontal-rgb.png"))
    assert main(["detect", str(folder / "frontal-rgb.png"), "--scene", str(folder / "scene.toml")]) == 0


def test_a_marker_that_is_missed_fails_the_demo(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("fidsplat.vision.readback.detect", lambda image, families: [])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("FIDSPLAT_SCENES", str(tmp_path / "offline"))
    assert main(["demo", "--out", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "failed: " in out
    assert "captured scene: cannot download" in out
    assert "apriltag:36h11:5 in 'frontal'" in out
    assert "aruco:4x4_50:7 in 'hidden'" not in out


def test_the_markers_of_the_demo_are_boxes_or_gaussians(scene, tmp_path, capsys):
    soft = demo_scene(mixture="fitted")
    assert (scene.cloud().footprint, soft.cloud().footprint) == ("mixed", "gaussian")
    assert [p.marker.spec for p in soft.markers] == [p.marker.spec for p in scene.markers]
    assert len(scene.cloud()) < len(soft.cloud())
    assert main(["demo", "--out", str(tmp_path), "--mixture", "sharp"]) == 2
    assert "sharp" in capsys.readouterr().err


def test_the_scene_is_the_same_every_time(scene):
    again = demo_scene().cloud()
    one = scene.cloud()
    for name in ("means", "quats", "scales", "opacities", "colors", "labels"):
        assert np.array_equal(getattr(one, name), getattr(again, name)), name
    assert set(np.unique(one.labels)) == {0, 1, 2, 3}


def test_the_demo_has_disks_boxes_and_3d_gaussians(scene):
    cloud = scene.cloud()
    assert (cloud.footprint, cloud.ellipsoids) == ("mixed", "some")
    assert 0.05 < np.mean(cloud.thickness[cloud.labels == 0] > 0) < 0.2


def test_the_markers_in_a_captured_scene_are_lit_by_it(blob):
    views, splats = run_captured("playbot", fs.Renderer("opencl"), "scene")
    assert set(splats) == {"apriltag:36h11:5", "qr:fidsplat"}
    assert all(Sighting(view.name, reading).passed for view in views for reading in view.readings)
    assert not any(view.others for view in views)
