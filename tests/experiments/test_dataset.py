"""The data set as COLMAP itself reads it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from paper_dataset import POINTS, dataset_scenes, scene_name, write_dataset, write_scene

import fidsplat as fs
from fidsplat.experiments.blender import record_images
from fidsplat.experiments.setup import CATEGORIES, novel_cameras, training_cameras
from fidsplat.experiments.views import exact_view
from fidsplat.formats.colmap import save_colmap
from fidsplat.images.files import read_image, to_uint8, write_png
from fidsplat.markers import marker

# pycolmap and OpenCV bring two libraries of one name and cannot live in one process
READ = """
import json, sys, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
lenses = {i: (c.model.name, c.width, c.height, *c.params) for i, c in model.cameras.items()}
images = {i.name: (i.cam_from_world().matrix().tolist(), *lenses[i.camera_id]) for i in model.images.values()}
points = [(*p.xyz.tolist(), *p.color.tolist()) for _, p in sorted(model.points3D.items())]
assert sorted(model.points3D) == list(range(1, len(points) + 1))
print(json.dumps({"images": images, "points": points, "cameras": len(lenses)}))
"""


def colmap(folder, suffix, work) -> dict:
    """Content of the files of one kind, read by pycolmap."""
    for name in ("cameras", "images", "points3D"):
        shutil.copy(folder / f"{name}{suffix}", work)
    done = subprocess.run([sys.executable, "-c", READ, str(work)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    part = {"category": "small", "index": 3, "views": 5}
    return write_scene(part, tmp_path_factory.mktemp("data"), 0, "exact", Path("nowhere"))


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("which", ["training", "test"])
def test_colmap_reads_what_was_written(scene, tmp_path, suffix, which):
    folder, stem = (scene, "view") if which == "training" else (scene / "test", "test")
    cameras = training_cameras(5) if which == "training" else novel_cameras(CATEGORIES["small"], 3)
    model = colmap(folder / "sparse" / "0", suffix, tmp_path)
    assert model["cameras"] == 1
    assert set(model["images"]) == {f"{stem}-{i:02d}.png" for i in range(len(cameras))}
    for i, camera in enumerate(cameras):
        pose, *lens = model["images"][f"{stem}-{i:02d}.png"]
        assert np.abs(np.array(pose) - camera.world_to_camera[:3]).max() < 1e-14
        assert lens == ["PINHOLE", 800, 800, camera.fx, camera.fy, 400.0, 400.0]
    points = np.array(model["points"])
    assert len(points) == POINTS
    assert np.all(points[:, 2] == 0)
    assert np.abs(points[:, :2]).max() <= 1.0
    grid = marker(CATEGORIES["small"].spec(3)).grid
    column, row = np.floor((points[:, :2] + 1) / 2 * grid.shape[0]).astype(int).T
    assert np.array_equal(points[:, 3:], np.repeat(255 * (1 - grid[row, column])[:, None], 3, 1))


def test_images_show_what_the_cameras_see(scene):
    spec = CATEGORIES["small"].spec(3)
    for folder, name, camera in (
        (scene, "view-04.png", training_cameras(5)[4]),
        (scene / "test", "test-19.png", novel_cameras(CATEGORIES["small"], 3)[19]),
    ):
        image = read_image(folder / "images" / name)
        assert np.array_equal(image[:, :, 0], to_uint8(exact_view(spec, camera, False)))
    assert len(list((scene / "images").glob("*.png"))) == 5
    assert len(list((scene / "test" / "images").glob("*.png"))) == 20


def test_a_scene_that_is_whole_stays_and_another_truth_renders_it_again(scene):
    part = {"category": "small", "index": 3, "views": 5}
    image = scene / "images" / "view-00.png"
    before = image.stat().st_mtime_ns
    write_scene(part, scene.parent, 0, "exact", Path("nowhere"))
    assert image.stat().st_mtime_ns == before
    note = json.loads((scene / "marker.json").read_text())
    assert note["spec"] == CATEGORIES["small"].spec(3)
    assert note["module_m"] * 33 == pytest.approx(2.0)
    (scene / "marker.json").unlink()  # as an interrupt leaves it
    write_scene(part, scene.parent, 0, "exact", Path("nowhere"))
    assert image.stat().st_mtime_ns > before


def test_blenders_images_become_the_scenes(tmp_path):
    part = {"category": "apriltag", "index": 0, "views": 3}
    with pytest.raises(fs.InputError, match=r"view-00\.png is missing; run fidsplat experiment blender"):
        write_scene(part, tmp_path / "out", 0, "blender-raw", tmp_path / "blender")
    folder = tmp_path / "blender" / "raw" / "apriltag-0"
    folder.mkdir(parents=True)
    for stem, count in (("view", 3), ("test", 20)):
        for i in range(count):
            write_png(folder / f"{stem}-{i:02d}.png", np.full((800, 800, 3), i, np.uint8))
    scene = write_scene(part, tmp_path / "out", 0, "blender-raw", tmp_path / "blender")
    assert read_image(scene / "images" / "view-02.png")[0, 0].tolist() == [2, 2, 2]
    assert read_image(scene / "test" / "images" / "test-19.png")[0, 0].tolist() == [19, 19, 19]


def test_a_scene_of_one_truth_that_a_stop_left_with_images_of_two_is_rendered_again(tmp_path):
    part = {"category": "apriltag", "index": 0, "views": 3}
    scene = write_scene(part, tmp_path / "out", 0, "exact", Path("nowhere"))
    first = (scene / "images" / "view-00.png").read_bytes()
    folder = tmp_path / "blender" / "raw" / "apriltag-0"
    folder.mkdir(parents=True)
    write_png(folder / "view-00.png", np.zeros((800, 800, 3), np.uint8))
    with pytest.raises(fs.InputError, match=r"view-01\.png is missing"):  # stopped after one image
        write_scene(part, tmp_path / "out", 0, "blender-raw", tmp_path / "blender")
    write_scene(part, tmp_path / "out", 0, "exact", Path("nowhere"))
    assert (scene / "images" / "view-00.png").read_bytes() == first
    (scene / "marker.json").write_text("{")
    write_scene(part, tmp_path / "out", 0, "exact", Path("nowhere"))
    assert json.loads((scene / "marker.json").read_text())["truth"] == "exact"


def test_there_are_a_hundred_scenes():
    work = dataset_scenes(CATEGORIES.values())
    assert len({scene_name(part) for part in work}) == 100


def test_models_with_several_lenses_and_names_that_cannot_be(tmp_path):
    cameras = [fs.Camera.look_at(64 + i % 2, 48, 1.0, (0, 0, -2 - i), (0, 0.1 * i, 0)) for i in range(4)]
    names = ["a.png", "b/c.png", "d.png", "e.png"]
    save_colmap(tmp_path / "m", names, cameras, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    model = colmap(tmp_path / "m", ".bin", tmp_path)
    assert model["cameras"] == 2
    assert {name: lens[1:3] for name, (_, *lens) in model["images"].items()} == {
        name: [camera.width, 48] for name, camera in zip(names, cameras, strict=True)
    }
    for bad in ("with blank.png", "", "two\nlines.png"):
        with pytest.raises(fs.InputError, match="the name of a COLMAP image must"):
            save_colmap(tmp_path / "n", [bad], cameras[:1], np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(fs.InputError, match="a name for each camera"):
        save_colmap(tmp_path / "n", names, cameras[:2], np.zeros((0, 3)), np.zeros((0, 3)))


def test_all_scenes_of_a_category(tmp_path, monkeypatch):
    folder = tmp_path / "blender" / "raw" / "apriltag-0"
    folder.mkdir(parents=True)
    for stem, count in (("view", 17), ("test", 20)):
        for i in range(count):
            write_png(folder / f"{stem}-{i:02d}.png", np.zeros((8, 8), np.uint8))
    monkeypatch.setattr("paper_dataset.dataset_scenes", lambda categories: dataset_scenes(categories, 1))
    words = tmp_path / "out", "blender-raw", tmp_path / "blender"
    write_dataset(*words, categories=[CATEGORIES["apriltag"]])
    names = [f"apriltag-0-views-{n}" for n in (3, 5, 9, 17)]
    assert [len(list((tmp_path / "out" / name / "images").iterdir())) for name in names] == [3, 5, 9, 17]
    record_images(tmp_path / "blender", "raw", 0, 16)
    with pytest.raises(fs.InputError, match="must have seed 1, got 0"):
        write_dataset(*words, seed=1)
