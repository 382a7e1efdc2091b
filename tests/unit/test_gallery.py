"""`fidsplat gallery`: a page of images."""

import json
from urllib.parse import quote

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import read_image, to_uint8

SCENE = (
    "# A tag <b>, alone. fidsplat render a.toml\n"
    "[camera]\nwidth = 24\nheight = 18\nfov_x_deg = 60.0\nposition = [0.0, 0.0, -1.0]\n"
    'look_at = [0.0, 0.0, 0.0]\n[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.4\n'
    '[render]\noutputs = ["rgb", "depth"]\n'
)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIDSPLAT_DEVICE", "reference")
    (tmp_path / "a.toml").write_text(SCENE)
    fs.save_ply(fs.SplatCloud([[0, 0, 1]], [[1, 0, 0, 0]], [[0.1, 0.1]], [1.0], colors=[[1, 0, 0]]), "b.ply")
    return tmp_path


def test_a_page_shows_scenes_with_their_outputs_and_text(here, capsys):
    (here / "c#2.toml").write_text(SCENE.replace("# A", "#A second").replace('["rgb", "depth"]', '["rgb"]'))
    assert main(["gallery", "a.toml", "c#2.toml", "-o", "out", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    page = (here / "out" / "index.html").read_text()
    assert "A tag &lt;b&gt;, alone" in page
    assert "<b>" not in page
    assert "aruco:4x4_50:7" in page
    assert "position = [0.0, 0.0, -1.0]" in page
    images = sorted(file.name for file in (here / "out").glob("*.png"))
    assert len(images) == 3
    assert all(f'src="{quote(name)}"' in page for name in images)
    assert any("#" in name for name in images)
    rgb = fs.Renderer("reference").render(fs.Scene.load("a.toml"))["rgb"]
    np.testing.assert_array_equal(read_image(facts["pictures"][0]), to_uint8(rgb))
    # what has not changed is not rendered again, what has is
    before = {file: file.stat().st_mtime_ns for file in (here / "out").glob("*.png")}
    (here / "c#2.toml").write_text(SCENE.replace("0.4", "0.3"))
    assert main(["gallery", "a.toml", "c#2.toml", "-o", "out"]) == 0
    after = {file: file.stat().st_mtime_ns for file in (here / "out").glob("*.png")}
    assert {file: after[file] for file in before} == before
    assert len(after) == 5


def test_what_cannot_be_shown_is_reported(here, capsys):
    for words, why in (
        ([], "must be at least one scene file"),
        (["none.toml"], "none.toml"),
        (["a.png"], "got a.png"),
    ):
        assert main(["gallery", *words]) == 2
        assert why in capsys.readouterr().err
    assert not (here / "fidsplat-gallery").exists()
