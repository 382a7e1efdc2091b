"""Plants as meshes and from Blender: growth, images, training, and placement in a greenhouse."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments import blender, plants
from fidsplat.experiments.plants import PlantSettings, cameras_around, write_plants
from fidsplat.images.files import read_rgba
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.worlds.greenhouse import Greenhouse
from fidsplat.worlds.plants import KINDS, Mesh, load_plants


@pytest.mark.parametrize("kind", KINDS)
def test_a_mesh_has_its_foot_at_the_origin_and_splats_cover_it(kind):
    mesh = KINDS[kind](np.random.default_rng(0))
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert -0.02 < low[2] < 0.02
    assert (0.1 if kind == "lettuce" else 1.0) < high[2] < 2.0
    assert np.abs([low[:2], high[:2]]).max() < 0.6
    cloud = mesh.splats(3000)
    assert len(cloud) == 3000
    assert not cloud.dropped
    gaps = np.linalg.norm(mesh.vertices[::9, None] - cloud.world_means()[None, ::3], axis=-1).min(1)
    assert np.quantile(gaps, 0.99) < 0.05  # no part of it is without
    assert np.ptp(mesh.splats(3000, seed=1).means - cloud.means) > 0.01


def test_splats_are_in_the_faces_and_have_their_colours():
    """Of two squares, one of three metres and one of one."""
    corners = np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0]], float)
    corners = np.concatenate([corners, corners / 3 + [5, 0, 0]])
    colors = np.array([[1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 1, 0], *4 * [[0, 0, 1]]], float)
    cloud = Mesh(corners, np.arange(8).reshape(2, 4), colors).splats(500)
    large = cloud.means[:, 0] < 4
    assert large.sum() == pytest.approx(450, abs=1)
    assert (cloud.colors[~large] == [0, 0, 1]).all()
    on = cloud.means[:, :2] - np.where(large, 0, 5)[:, None] * [1, 0]
    assert (on >= 0).all()
    assert (on <= np.where(large, 3, 1)[:, None]).all()
    assert np.abs(cloud.means[:, 2]).max() < 1e-7
    turned = quaternion_to_matrix(cloud.quats.astype(float))[:, :, 2]
    np.testing.assert_allclose(np.abs(turned[:, 2]), 1, atol=1e-6)
    # of the two triangles of a square: red falls along the farther of its sides
    red = 1 - np.max(cloud.means[large, :2], axis=1) / 3
    np.testing.assert_allclose(cloud.colors[large, 0], red, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_see_the_whole_plant(kind):
    mesh = PlantSettings().mesh(kind, 0)
    cameras = cameras_around(mesh, 12)
    for camera in cameras:
        pixels = camera.project(mesh.vertices)
        assert (pixels > 0).all()
        assert (pixels < [camera.width, camera.height]).all()
        assert np.ptp(pixels, axis=0).max() > 100
    assert len({camera.position.tobytes() for camera in (*cameras, *cameras_around(mesh, 12, 0.5))}) == 24


def test_a_stock_of_sampled_plants_fills_a_greenhouse(tmp_path, capsys):
    words = ["experiment", "plants", "-o", str(tmp_path / "p"), "--iterations", "0", "--splats", "300"]
    assert main([*words, "--each", "2", "--kind", "tomato", "--kind", "lettuce", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)["plants"]
    names = ["tomato-0", "lettuce-0", "tomato-1", "lettuce-1"]
    assert [Path(one["file"]).stem for one in written] == names
    stock = load_plants(tmp_path / "p")
    assert {kind: [len(one) for one in own] for kind, own in stock.items()} == {
        "lettuce": [300, 300], "tomato": [300, 300]
    }  # fmt: skip
    assert all(one.sh is None for own in stock.values() for one in own)
    house, grown = Greenhouse(2, 3, stock=stock), Greenhouse(2, 3)
    assert len(house._plants()) == 6 * 300
    heights = house._plants().world_means()[:, 2].reshape(2, -1).max(1)
    assert heights[0] < 0.8 < 1.5 < heights[1]  # a row of lettuces, and one of tomatoes, on benches
    assert house.mjcf() == grown.mjcf()
    out = ["greenhouse", "-o", str(tmp_path / "g"), "--rows", "1", "--plants", "2", "--json"]
    assert main([*out, "--plants-from", str(tmp_path / "p")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["splats"] == len(Greenhouse(1, 2, stock=stock).scene.cloud())
    # what is there stays
    before = (tmp_path / "p/tomato-0.ply").stat().st_mtime_ns
    assert main([*words, "--each", "1"]) == 0
    assert (tmp_path / "p/tomato-0.ply").stat().st_mtime_ns == before
    capsys.readouterr()
    for more, message in (
        (["--seed", "1"], "give another folder"),
        (["--kind", "tomatoe"], "unknown kind of plant 'tomatoe' (did you mean 'tomato'?)"),
        (["--splats", "1"], "plants: splats must be a whole number from 100"),
    ):
        assert main([*words, *more]) == 2
        assert message in capsys.readouterr().err
    assert main(["greenhouse", "-o", str(tmp_path / "h"), "--plants-from", str(tmp_path)]) == 2
    assert "must have plants as KIND-NUMBER.ply" in capsys.readouterr().err
    with pytest.raises(fs.InputError, match="must have at least one plant of each kind"):
        Greenhouse(1, 1, stock={"tomato": []})


def test_plants_of_other_sources_are_not_mixed(tmp_path, monkeypatch):
    plants._record(PlantSettings(), tmp_path)
    plants._record(PlantSettings(), tmp_path)
    monkeypatch.setattr(plants, "code_hash", lambda: "another")
    with pytest.raises(fs.InputError, match=r"'sources': 'another'.*; give another folder"):
        plants._record(PlantSettings(), tmp_path)


def test_without_blender_the_error_says_how_to_get_it(tmp_path):
    with pytest.raises(fs.InputError, match=r"fidsplat experiment blender --install"):
        list(write_plants(PlantSettings(("lettuce",), 1), tmp_path, tmp_path / "nowhere"))


FAKE = """
import json, sys
import numpy as np, cv2
for plant in json.load(open(sys.argv[1]))["objects"]:
    assert len(plant["vertices"]) == len(plant["colors"]) > max(map(max, plant["quads"]))
    for shot in plant["images"]:
        picture = np.zeros((shot["height"], shot["width"], 4), np.uint8)
        picture[100:200, 50:100] = (0, 200, 0, 255)
        cv2.imwrite(shot["file"], picture)
        print("done", shot["file"], flush=True)
"""


def test_images_become_a_data_set_and_the_trained_splats_a_plant(tmp_path, monkeypatch):
    (tmp_path / "worker.py").write_text(FAKE)
    monkeypatch.setattr(plants, "WORKER", tmp_path / "worker.py")
    monkeypatch.setattr(blender, "environment_python", lambda environment: Path(sys.executable))
    requested = {}

    class Quick:
        """Trains nothing, and makes one splat too faint to stay."""

        def __init__(self, dataset, renderer, settings, checkpoint, start):
            requested.update(dataset=dataset, settings=settings, start=start)

        def run(self, progress):
            progress(SimpleNamespace(psnr=30.0, iteration=5))

        def evaluate(self):
            return [SimpleNamespace(psnr=psnr) for psnr in (30.0, 34.0)]

        def cloud(self):
            start, faint = requested["start"], requested["start"].opacities.copy()
            faint[0] = 0.01
            sh = (start.colors[:, None] - 0.5) / 0.28209479
            return fs.SplatCloud(start.means, start.quats, start.scales, faint, sh=sh)

    monkeypatch.setattr(plants, "Trainer", Quick)
    reported = []
    expected = PlantSettings(("lettuce",), 1, views=3, test=2, splats=200, iterations=5)
    out = tmp_path / "out"
    splats = list(
        write_plants(expected, out, tmp_path, "reference", lambda step, fraction: reported.append(fraction))
    )
    assert splats == [(out / "lettuce-0.ply", 32.0)]
    data = requested["dataset"]
    assert (len(data.views), len(data.held_out), len(data.points)) == (3, 2, 200)
    assert data.background == plants.BACKGROUND
    np.testing.assert_array_equal(data.views[0].image[150, 75], (0, 200, 0))
    np.testing.assert_array_equal(data.views[0].image[0, 0], np.rint(255 * np.array(plants.BACKGROUND)))
    assert (requested["settings"].iterations, requested["settings"].sh_degree) == (5, 0)
    (plant,) = load_plants(out)["lettuce"]
    assert len(plant) == 199
    np.testing.assert_allclose(plant.colors, requested["start"].colors[1:], atol=1e-6)
    assert reported == sorted(reported)
    assert reported[-1] == 1.0


def test_blender_renders_a_plant(tmp_path):
    """Where it is installed: a lettuce, green in the middle, with nothing around it."""
    python = blender.environment_python(blender.default_environment())
    if not python.is_file():
        pytest.skip("Blender is not here; fidsplat experiment blender --install")
    expected = PlantSettings(("lettuce",), 1, views=2, test=1, samples=4)
    plants._render(
        expected, expected.mesh("lettuce", 0), tmp_path / "lettuce-0", python, lambda step, fraction: None
    )
    picture = read_rgba(tmp_path / "lettuce-0/images/view-000.png").astype(int)
    assert picture[0, 0, 3] == 0
    seen = picture[picture[..., 3] == 255]
    assert len(seen) > 2000
    red, green, blue, _ = seen.mean(0)
    assert green > 1.2 * red > 1.2 * blue
    assert 60 < green < 230
