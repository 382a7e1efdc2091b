"""The command `fidsplat train`: its files, messages and checkpoints."""

import json
import os
import shutil
import signal

import pytest
from training_scene import scene, write

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.train import Trainer


@pytest.fixture
def folder(tmp_path):
    write(scene(count=6), tmp_path / "set")
    return tmp_path / "set"


def test_the_command_trains_resumes_and_reports(folder, tmp_path, capsys):
    words = [
        "train",
        str(folder),
        "-o",
        str(tmp_path / "a.ply"),
        "--device",
        "reference",
        "--iterations",
        "4",
    ]
    assert main([*words, "--json", "--report", str(tmp_path / "page")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["iterations"] == 4
    assert facts["splats"] == len(fs.load_ply(tmp_path / "a.ply")) == 6
    assert [view["name"] for view in facts["views"]] == ["0.png"]
    assert all(
        (tmp_path / "page" / name).is_file() for name in ("report.md", "training.svg", "held-out-0.png")
    )
    first = (tmp_path / "a.ply").read_bytes()
    words[3] = str(tmp_path / "b.ply")
    assert main([*words[:-1], "2"]) == 0
    assert main(words) == 0  # goes on
    assert (tmp_path / "b.ply").read_bytes() == first
    assert main([*words[:-1], "3"]) == 2
    assert "number of iterations" in capsys.readouterr().err
    assert main([*words[:-1], "3", "--overwrite"]) == 0
    solid = [*words[:2], "-o", str(tmp_path / "d.ply"), *words[4:], "--primitive", "3d", "--start"]
    assert main([*solid, str(tmp_path / "a.ply")]) == 0
    assert (fs.load_ply(tmp_path / "d.ply").thickness > 0).all()
    assert main([*solid, str(tmp_path / "none.ply"), "--overwrite"]) == 2
    solid[3] = str(tmp_path / "e.ply")
    assert main([*solid, str(tmp_path / "a.ply"), "--iterations", "2"]) == 0
    assert main([*solid, str(tmp_path / "a.ply")]) == 0  # goes on
    assert (tmp_path / "e.ply").read_bytes() == (tmp_path / "d.ply").read_bytes()
    for wrong, message in (
        (["-o", "a.png"], "-o must be a .ply file, got a.png"),
        (["--random-points", "-1"], "--random-points must be"),
        (["--random-points", "99999999999"], "--random-points must be"),
        (["--within-memory", "0"], "--within-memory must be above 0 GiB, got 0"),
        (["--within-memory", "1e-6"], "must be more than the 0.0001 GiB of the images"),
    ):
        assert main([*words, *wrong]) == 2
        assert message in capsys.readouterr().err
    shutil.rmtree(folder / "test")
    words[3] = str(tmp_path / "c.ply")
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "PSNR" not in printed
    assert "no view was held out; --hold-out 8" in " ".join(printed.split())


def test_a_run_that_is_interrupted_keeps_what_it_has_done(folder, tmp_path, capsys, monkeypatch):
    """At the end of the step, whenever the signal arrives; the second signal does not wait."""
    words = ["train", str(folder), "--device", "reference", "--iterations", "6", "-o"]
    assert main([*words, str(tmp_path / "whole.ply")]) == 0
    advance, interrupts = Trainer._advance, [1]

    def interrupted(self, late):
        for _ in range(interrupts[0] if self.iteration == 3 else 0):
            os.kill(os.getpid(), signal.SIGINT)
        advance(self, late)

    monkeypatch.setattr(Trainer, "_advance", interrupted)
    file = tmp_path / "a.ply"
    assert main([*words, str(file)]) == 130
    error_output = capsys.readouterr().err
    assert "the same command resumes after iteration 4" in error_output
    assert not file.exists()
    assert main([*words, str(file)]) == 0
    assert file.read_bytes() == (tmp_path / "whole.ply").read_bytes()
    interrupts[0] = 2
    monkeypatch.setattr("fidsplat.util.interrupts.REPEAT", 0.0)
    assert main([*words, str(tmp_path / "b.ply")]) == 130
    assert list(tmp_path.glob("b.*")) == []
