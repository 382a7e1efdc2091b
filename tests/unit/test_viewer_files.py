"""Poses that go back into scene files."""

import math
import tomllib

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.viewer.scene_file import SceneFile, with_pose

FILE = """# a scene, with words of its own
[camera]   # where from
width = 33

[[markers]]
spec = "aruco:4x4_50:7"   # the first
size = 0.4

[[ markers ]] # the second
spec = "aruco:4x4_50:8"
size = 0.4
position = [ 1.0,
             2.0, 3.0 ]  # metres
quaternion = [1, 0, 0, 0]

[render]
outputs = ["rgb"]
"""
POSE = rigid_matrix((0.25, -0.5, 1 / 3), (math.cos(0.3), 0, math.sin(0.3), 0))


@pytest.mark.parametrize("number", [0, 1])
def test_a_moved_marker_goes_back_into_its_file(number):
    new = with_pose(FILE, number, POSE, "scene.toml")
    written, before = tomllib.loads(new), tomllib.loads(FILE)
    marker = written["markers"][number]
    np.testing.assert_allclose(rigid_matrix(marker["position"], marker["quaternion"]), POSE, atol=1e-8)
    for key in ("position", "quaternion"):
        marker.pop(key), before["markers"][number].pop(key, None)
    assert written == before
    for words in ("# a scene, with words", "# the first", "# the second", "# where from"):
        assert words in new
    assert with_pose(new, number, POSE, "") == new


def test_the_mark_of_an_editor_stays():
    new = with_pose("\ufeff" + FILE, 0, POSE, "scene.toml")
    assert new == "\ufeff" + with_pose(FILE, 0, POSE, "scene.toml")


@pytest.mark.parametrize(
    ("text", "number"),
    [(FILE, 2), ('markers = [{spec = "a", size = 1.0}]\n', 0), ("x = '''\n[[markers]]\n'''", 0), ("[", 0)],
)
def test_a_file_that_is_written_otherwise_is_unchanged(text, number):
    with pytest.raises(fs.InputError, match=rf"s.toml: marker {number} must be a plain .*write position"):
        with_pose(text, number, POSE, "s.toml")


def test_a_file_that_was_edited_meanwhile_is_not_written(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FILE)
    file = SceneFile(path)
    assert not file.changed()
    file.write_pose(0, POSE)
    assert not file.changed()  # our own hand
    assert "position = [0.25, -0.5, 0.333333333]" in path.read_text()
    path.write_text(FILE + "\n# edited")
    with pytest.raises(fs.InputError, match="was edited by another program; it is loaded again"):
        file.write_pose(0, POSE)
    assert path.read_text() == FILE + "\n# edited"
    text = file.changed()
    assert text == FILE + "\n# edited"
    assert file.changed() is None
    with pytest.raises(fs.InputError, match="was edited by another program"):
        file.write_pose(0, POSE)  # until the scene of that text is shown
    file.text = text
    file.write_pose(0, POSE)
    path.unlink()
    with pytest.raises(fs.InputError, match="cannot read"):
        file.changed()


def test_a_link_to_a_scene_file_stays_one(tmp_path):
    (tmp_path / "real.toml").write_text(FILE)
    link = tmp_path / "scene.toml"
    link.symlink_to("real.toml")
    SceneFile(link).write_pose(0, POSE)
    assert link.is_symlink()
    assert "position = [0.25" in (tmp_path / "real.toml").read_text()
