"""`fidsplat view RUN`: a flight's folder, and a running training."""

import os
from dataclasses import replace

import numpy as np
import pytest
from training_scene import BACKGROUND, QUICK, scene

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.commands.view import Target, Training, View, find_checkpoint
from fidsplat.train import Trainer, splats_of

SCENE = (
    "[camera]\nwidth = 12\nheight = 9\nfov_x_deg = 60.0\nposition = [0.0, 0.0, -1.0]\n"
    'look_at = [0.0, 0.0, 0.0]\n[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.4\n'
)


@pytest.fixture
def flight(tmp_path, monkeypatch):
    """A flight of one frame."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "poses.tum").write_text("0 0 0 -1 0 0 0 1\n")
    words = ["scene.toml", "--trajectory", "poses.tum", "-o", "runs/one", "--device", "reference"]
    assert main(["fly", *words]) == 0
    return tmp_path / "runs" / "one"


def test_a_flight_is_its_scene_and_its_poses(flight, monkeypatch):
    monkeypatch.chdir(flight.parent)  # the scene is found from any folder
    shown = View("one")._target()
    assert shown.training is None
    assert os.path.samefile(shown.source, "../scene.toml")
    assert len(fs.load_trajectory(shown.trajectory)) == 1
    assert View("one", trajectory="other.tum")._target().trajectory == "other.tum"
    assert View("../scene.toml")._target() == Target("../scene.toml", None)


def test_without_a_scene_the_demo_is_shown():
    scene = View()._target().scene("fast", lambda step, fraction: None)
    assert [placed.marker.kind for placed in scene.markers] == ["apriltag", "aruco", "qr"]
    assert scene.capture.quality == fs.Quality.named("fast")


def test_a_splat_file_is_shown_by_the_quality_that_is_given(tmp_path):
    file = tmp_path / "a.ply"
    fs.save_ply(fs.marker("aruco:4x4_50:7", size=0.4).gaussians, file)
    scene = View(str(file))._target().scene("samples=2", lambda step, fraction: None)
    assert scene.capture.quality.samples == 2


def test_a_scene_file_that_is_edited_keeps_the_quality_that_was_given(flight, monkeypatch):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer import server

    results = []

    class Page(server.Viewer):
        def __init__(self, *words, **more):
            super().__init__(*words, **more)
            results.append(self.session)
            file = self._file.path
            file.write_text(file.read_text().replace("0.4", "0.2"))
            for _ in range(100):
                if self.session.state.scene.markers[0].marker.size == 0.2:
                    break
                self._closed.wait(0.05)
            self.close()
            raise fs.InputError("enough")

    monkeypatch.setattr(server, "Viewer", Page)
    words = ["--quality", "samples=2", "--device", "reference", "--port", "0"]
    assert main(["view", str(flight.parents[1] / "scene.toml"), *words]) == 2
    scene = results[0].state.scene
    assert (scene.markers[0].marker.size, scene.capture.quality.samples) == (0.2, 2)


def test_paths_that_are_not_runs_are_reported(flight, capsys):
    (flight.parents[1] / "scene.toml").unlink()
    for folder, words in (
        (flight, "the scene of the flight"),
        (flight.parent, "a folder to view must contain"),
    ):
        assert main(["view", str(folder)]) == 2
        assert words in capsys.readouterr().err
    for damaged in ("{", "[]", '{"source": null}'):
        (flight / "flight.json").write_text(damaged)
        assert main(["view", str(flight)]) == 2
        assert "a folder to view must contain" in capsys.readouterr().err


@pytest.fixture(scope="module")
def trainer(tmp_path_factory):
    """A run of one step."""
    dataset = scene(views=2, held_out=0, size=(12, 9))
    file = tmp_path_factory.mktemp("run") / "yard.training.npz"
    short_trainer = Trainer(dataset, fs.Renderer("reference"), iterations=9, checkpoint=file, **QUICK)
    short_trainer.step()
    short_trainer.save_checkpoint()
    return short_trainer


def test_a_checkpoint_holds_what_is_rendered(trainer):
    cloud, background = splats_of(trainer.checkpoint)
    assert background == BACKGROUND
    expected = trainer.cloud()
    for name in ("means", "quats", "scales", "opacities", "sh", "origin"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(expected, name))


def test_a_training_is_shown_as_it_grows(trainer):
    folder = trainer.checkpoint.parent
    for source in (folder, trainer.checkpoint):
        run = View(str(source), quality="fast")._target().training
        assert isinstance(run, Training)
        assert run.file == trainer.checkpoint
    first = run.scene
    assert first.capture.background == BACKGROUND
    assert first.capture.quality == fs.Quality.named("fast")
    assert run.reload() is None
    trainer.step()
    trainer.save_checkpoint()
    os.utime(run.file, ns=(1, 1))  # however coarse the file system's clock is
    second = run.reload()
    assert second.camera is first.camera
    assert not np.array_equal(second.cloud().means, first.cloud().means)
    assert run.reload() is None
    content = run.file.read_bytes()
    run.file.unlink()
    assert run.reload() is None  # the checkpoint is being replaced
    run.file.write_bytes(content[:-9])
    with pytest.raises(fs.InputError, match="as a checkpoint of `fidsplat train`"):
        run.reload()
    run.file.write_bytes(content)


def test_the_page_shows_the_newest_splats(trainer):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer.server import Viewer

    first = Training(trainer.checkpoint).scene
    newer = [replace(first, background=(1, 1, 1))]
    viewer = Viewer(first, device="reference", port=0, reload=lambda: newer.pop() if newer else None)
    try:
        for _ in range(100):
            if viewer.session.state.scene is not first:
                break
            viewer._closed.wait(0.05)
        assert viewer.session.state.scene.capture.background == (1, 1, 1)
    finally:
        viewer.close()


def test_several_runs_in_a_folder_are_named(tmp_path):
    assert find_checkpoint(tmp_path) is None
    for name in ("a", "b"):
        (tmp_path / f"{name}.training.npz").touch()
    with pytest.raises(fs.InputError, match=r"got several; name one of a.training.npz, b.training"):
        find_checkpoint(tmp_path)
    with pytest.raises(fs.InputError, match="as a checkpoint"):
        Training(tmp_path / "a.training.npz")
