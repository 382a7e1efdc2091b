"""The greenhouse: the same for the same seed, tags that are read where they hang, files that load."""

import json

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.vision import read_back
from fidsplat.worlds.greenhouse import AISLE, BENCH, PLANT_SPLATS, SPACING, TAG_HEIGHT, Greenhouse, facing
from fidsplat.worlds.plants import KINDS


@pytest.fixture(scope="module")
def small():
    return Greenhouse(2, 3, seed=5)


def test_the_same_numbers_give_the_same_greenhouse(small):
    again, other = Greenhouse(2, 3, seed=5), Greenhouse(2, 3, seed=6)
    assert small.scene.cloud().means.tobytes() == again.scene.cloud().means.tobytes()
    assert len(small.scene.cloud()) != len(other.scene.cloud()) or (
        small.scene.cloud().means.tobytes() != other.scene.cloud().means.tobytes()
    )


@pytest.mark.parametrize("kind", KINDS)
def test_plants_have_the_foot_at_the_origin(kind):
    cloud = KINDS[kind](np.random.default_rng(0)).splats(PLANT_SPLATS)
    low, high = cloud.bounds()
    assert -0.2 < low[2] < 0.1
    assert (0.12 if kind == "lettuce" else 1.0) < high[2] < 2.0
    assert np.abs([low[:2], high[:2]]).max() < 0.8
    assert not cloud.dropped


def test_a_marker_that_faces_a_side_is_upright_there():
    pose = facing((1, 2, 0.5), (0, -1))
    np.testing.assert_allclose(pose[:3, 2], [0, 1, 0])  # viewed from its -z, from where y is less
    np.testing.assert_allclose(pose[:3, 1], [0, 0, -1])
    np.testing.assert_allclose(pose[:3, 0], [1, 0, 0])
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_tags_are_read_from_the_aisle(small):
    x = 0.5 * small.length
    camera = fs.Camera.look_at(160, 120, 0.5, (x, AISLE / 2, TAG_HEIGHT), (x, 0, TAG_HEIGHT), (0, 0, 1))
    scene = fs.Scene(small.scene.clouds, camera, small.scene.markers)
    frame = fs.Renderer("opencl:pocl").render(scene, outputs=("rgb", "label"))
    read = [one for one in read_back(frame, scene).readings if one.detection is not None]
    (near,) = [one for one in read if one.visible > 0.9]
    assert near.distance == pytest.approx(AISLE / 2 - BENCH[0] / 2, abs=0.01)
    assert near.position_error < 0.01


def test_every_tag_has_an_id_of_its_own(small):
    tags = [placed.marker.id for placed in small.markers if placed.marker.kind == "apriltag"]
    assert tags == list(range(len(tags)))
    assert len([placed for placed in small.markers if placed.marker.kind == "qr"]) == 2


def test_the_model_loads_and_has_the_benches(small):
    mujoco = pytest.importorskip("mujoco", reason="pip install 'fidsplat[sim]'")
    model = mujoco.MjModel.from_xml_string(small.mjcf())
    bench = model.geom("bench 2")
    np.testing.assert_allclose(bench.pos, [1.5 * SPACING, AISLE, BENCH[1] / 2])
    np.testing.assert_allclose(bench.size, [1.5 * SPACING, BENCH[0] / 2, BENCH[1] / 2])


def test_the_scene_file_is_there_when_all_else_is(tmp_path, capsys):
    (tmp_path / "greenhouse.xml").mkdir()
    assert main(["greenhouse", "-o", str(tmp_path), "--rows", "1", "--plants", "1"]) == 2
    assert "must be a regular file" in capsys.readouterr().err
    assert not (tmp_path / "greenhouse.toml").exists()


def test_the_command(tmp_path, capsys):
    words = ["greenhouse", "-o", str(tmp_path / "g"), "--rows", "1", "--plants", "2", "--json"]
    assert main(words) == 0
    facts = json.loads(capsys.readouterr().out)
    scene = fs.Scene.load(facts["scene"])
    assert len(scene.cloud()) == facts["splats"]
    assert len(scene.markers) == facts["markers"]
    assert main(words) == 2
    assert "already exists" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    capsys.readouterr()
    assert main([*words[:3], "--rows", "0"]) == 2
    assert "rows of a greenhouse must be a whole number from 1 to 200, got 0" in capsys.readouterr().err
