"""The exact renderer against Blender's own images, and the process that makes them."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from experiments.blender_images import BOXES, IMAGES, blackman_harris, flat, ours, theirs

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments import blender
from fidsplat.experiments.setup import CATEGORIES
from fidsplat.vision.metrics import psnr


@pytest.mark.parametrize("name", IMAGES)
def test_inside_the_cells_the_images_are_equal(name):
    inside = flat(name, 2)
    assert inside.mean() > 0.3
    difference = np.abs(ours(name) - theirs(name))[inside]
    assert difference.max() * 255 < 1e-6
    assert psnr(ours(name)[inside], theirs(name)[inside]) >= 45


@pytest.mark.parametrize("name", BOXES)
def test_edges_agree_where_blender_averages_over_the_pixel(name):
    edges = ~flat(name, 2)
    assert psnr(ours(name)[edges], theirs(name)[edges]) >= 45


def test_edges_differ_by_the_pixel_filter_and_by_nothing_else():
    """Blender's default filter, applied to our supersampled image, reproduces Blender's image."""
    name = "tag-blackman-harris"
    edges = ~flat(name, 2)
    seen = theirs(name)
    box = psnr(ours(name)[edges], seen[edges])
    filtered = blackman_harris(name)
    own = psnr(filtered[edges], seen[edges])
    assert box < 35
    assert own >= 45
    # and it is the filter that makes the difference: theirs from ours is what the two filters differ by
    assert np.abs(filtered - seen).max() < 3 / 255


def test_the_standard_view_averages_linear_light():
    """Compared with an image of mean display values, Blender's 'Standard' view is lighter at edges, and
    only there."""
    display, standard = ours("tag-raw"), theirs("tag-standard")
    edges = ~flat("tag-standard", 2)
    assert psnr(display[edges], standard[edges]) < 25
    assert (standard - display)[edges].min() > -0.01


FAKE = """
import json, pathlib, sys
job = json.load(open(sys.argv[1]))
print("Blender says much else")
for marker in job["objects"]:
    for shot in marker["images"]:
        if "broken" in shot["file"]:
            sys.exit("Error: no device")
        pathlib.Path(shot["file"]).write_text(json.dumps({**job, "objects": marker["name"]}))
        print("done", shot["file"], flush=True)
"""


@pytest.fixture
def fake(tmp_path, monkeypatch) -> Path:
    """A worker that writes its orders instead of images."""
    script = tmp_path / "worker.py"
    script.write_text(FAKE)
    monkeypatch.setattr(blender, "WORKER", script)
    monkeypatch.setattr(blender, "environment_python", lambda environment: Path(sys.executable))
    return tmp_path


def test_existing_images_stay_and_missing_ones_are_rendered(fake):
    job = blender.marker_job(CATEGORIES["apriltag"], 1, 0, fake / "out", "raw", training=True)
    assert len(job["images"]) == 37
    first = Path(job["images"][0]["file"])
    first.parent.mkdir(parents=True)
    first.write_text("old")
    done = list(blender.render([job], "raw", fake, samples=7, threads=3))
    assert [str(file) for file in done] == [shot["file"] for shot in job["images"]]
    assert first.read_text() == "old"
    orders = json.loads(done[1].read_text())
    assert (orders["view"], orders["samples"], orders["filter"], orders["threads"]) == ("raw", 7, "BOX", 3)
    assert list(blender.render([job], "raw", fake)) == done


def test_the_command_renders_every_view_of_the_markers(fake, capsys):
    words = ["experiment", "blender", "-o", str(fake / "out"), "--category", "small", "--markers", "1"]
    assert main([*words, "--samples", "7"]) == 0
    assert f"40 images in {fake / 'out'}" in capsys.readouterr().out  # 20 test views, standard and raw
    assert main([*words, "--view", "raw", "--samples", "0"]) == 2
    assert "--samples must be at least 1, got 0" in capsys.readouterr().err


def test_when_blender_stops_its_last_words_are_the_error(fake):
    job = blender.marker_job(CATEGORIES["small"], 0, 0, fake / "broken", "standard", training=False)
    with pytest.raises(fs.DeviceError, match=r"Blender stopped with status 1: Error: no device"):
        list(blender.render([job], "standard", fake))


def test_without_blender_the_error_says_how_to_get_it(tmp_path):
    job = blender.marker_job(CATEGORIES["small"], 0, 0, tmp_path, "standard", training=False)
    with pytest.raises(fs.InputError, match=r"fidsplat experiment blender --install"):
        list(blender.render([job], "standard", tmp_path / "nowhere"))
    with pytest.raises(fs.InputError, match="unknown view 'agx'; known: standard, raw"):
        list(blender.render([job], "agx", tmp_path))
    camera = fs.Camera.pinhole(10, 10, 9.0, 8.0, 5.0, 5.0)
    with pytest.raises(fs.InputError, match="fx and fy of a Blender camera must be equal"):
        blender.image_job(tmp_path / "a.png", camera)


def test_installing_where_it_cannot_be(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    monkeypatch.setattr(blender, "sys", SimpleNamespace(version_info=(3, 11, 0), executable=sys.executable))
    with pytest.raises(fs.InputError, match="cannot write into the folder"):
        blender.install(tmp_path / "file" / "environment")
    monkeypatch.setattr(blender, "sys", SimpleNamespace(version_info=(3, 12, 1), executable=sys.executable))
    monkeypatch.setattr(blender.shutil, "which", lambda name: None)
    with pytest.raises(fs.InputError, match=r"python3\.11 must be on the path"):
        blender.install(tmp_path / "environment")


def test_what_pip_says_last_is_the_error(tmp_path, monkeypatch):
    monkeypatch.setattr(blender, "sys", SimpleNamespace(version_info=(3, 11, 0), executable=sys.executable))
    monkeypatch.setattr(blender, "environment_python", lambda environment: Path(sys.executable))
    monkeypatch.setattr(blender, "BPY", str(tmp_path / "no-such-package"))
    # the environment is not made: it takes 4 s, and this one's pip answers in its place
    call = blender._call
    monkeypatch.setattr(blender, "_call", lambda command: "venv" in command or call(command))
    with pytest.raises(
        fs.DeviceError, match=r"installing Blender failed at '-m pip install'.*no-such-package"
    ):
        blender.install(tmp_path / "environment")
