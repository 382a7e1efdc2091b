"""`fidsplat experiment` as a user meets it."""

import json
from dataclasses import replace

import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.commands.experiment import Experiment
from fidsplat.experiments import angles, localisation, views
from fidsplat.experiments import run as run_module
from fidsplat.experiments.blender import check_images, record_images
from fidsplat.experiments.settings import ExperimentSettings
from fidsplat.experiments.setup import PROTOCOLS
from fidsplat.experiments.sweep import read_records

SMALL = ["--category", "apriltag", "--markers", "1"]


def run(capsys, *words) -> tuple[int, str, str]:
    status = main(["experiment", *map(str, words)])
    return status, *capsys.readouterr()


@pytest.mark.parametrize("word", Experiment.PARTS)
def test_help_teaches(capsys, word):
    status, out, err = run(capsys, word, "--help")
    assert (status, err) == (0, "")
    assert f"usage: fidsplat experiment {word}" in out
    assert f"  fidsplat experiment {word}" in out
    assert Experiment.PARTS[word].__doc__.splitlines()[0] in out


def test_the_group_lists_its_words(capsys):
    status, out, _ = run(capsys, "--help")
    assert status == 0
    assert all(word in out for word in Experiment.PARTS)
    status, out, err = run(capsys)
    assert (status, out) == (2, "")
    assert "angles" in err
    status, _, err = run(capsys, "angels")
    assert status == 2
    assert err.count("\n") == 1
    assert "see fidsplat experiment --help" in err


def test_an_interrupted_scan_continues(capsys, tmp_path, monkeypatch):
    words = ("angles", "--ideal", *SMALL, "--tilts", "0:80:40", "-o", tmp_path, "--json")
    real, done = angles.measure_angles, []

    def stopped(part, **others):
        if done:
            raise KeyboardInterrupt
        done.append(part)
        return real(part, **others)

    monkeypatch.setattr(angles, "measure_angles", stopped)
    status, out, err = run(capsys, *words)
    assert (status, out) == (130, "")
    assert "interrupted" in err
    first = read_records(tmp_path / "angles.jsonl")
    assert len(first) == 1

    monkeypatch.setattr(angles, "measure_angles", real)
    status, out, _ = run(capsys, *words)
    assert status == 0
    assert json.loads(out) == {"files": {"angles": str(tmp_path / "angles.jsonl")}}
    records = read_records(tmp_path / "angles.jsonl")
    assert records[0] == first[0]
    assert [record.key["protocol"] for record in records] == ["fixed-plane", "fixed-module"]
    assert records[0].result["readers"]["pupil"]["read"] == "111"


def test_shards_merge_into_what_one_run_gives(capsys, tmp_path):
    words = ("angles", "--ideal", *SMALL, "--tilts", "0:80:40")
    assert run(capsys, *words, "-o", tmp_path / "whole")[0] == 0
    for i in (1, 2):
        assert run(capsys, *words, "--shard", f"{i}/2", "-o", tmp_path / f"machine-{i}")[0] == 0
    status, out, _ = run(
        capsys, "merge", tmp_path / "machine-1", tmp_path / "machine-2", "-o", tmp_path / "both", "--json"
    )
    assert status == 0
    assert json.loads(out)["angles"] == {
        "file": str(tmp_path / "both" / "angles.jsonl"), "files": 2, "points": 2, "repeated": 0,
        "missing": [],
    }  # fmt: skip

    def found(folder):
        records = read_records(tmp_path / folder / "angles.jsonl")
        return {json.dumps(record.key, sort_keys=True): record.result for record in records}

    assert found("both") == found("whole")


def test_a_quick_run_has_few_tilts_and_distances(tmp_path):
    quick, full = (ExperimentSettings(tmp_path, quick=quick) for quick in (True, False))
    for options, tilts in ((full, angles.FULL_TILTS), (quick, angles.QUICK_TILTS)):
        assert {point["tilts"] for point in run_module._points(angles.NAME, options)} == {tilts}
    for options, (distances, tilts) in ((full, localisation.FULL), (quick, localisation.QUICK)):
        for point in run_module._points(localisation.NAME, options):
            assert (tuple(point["distances"]), tuple(point["tilts"])) == (distances, tilts)


@pytest.mark.sweep
def test_everything_quick_and_its_report(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(angles, "QUICK_TILTS", "0:40:40")
    monkeypatch.setattr(localisation, "QUICK", ((1.0,), (0.0, 40.0)))
    monkeypatch.setattr(views, "flip", lambda ours, theirs: abs(ours - theirs).mean())
    for name, plane in PROTOCOLS.items():  # images of a quarter of the pixels
        module = plane.module_px and plane.module_px / 2
        monkeypatch.setitem(PROTOCOLS, name, replace(plane, pixels=plane.pixels // 2, module_px=module))
    monkeypatch.setattr(localisation, "WIDTH", localisation.WIDTH // 2)
    monkeypatch.setattr(localisation, "HEIGHT", localisation.HEIGHT // 2)
    words = ("all", "--quick", *SMALL, "--mixture", "fitted", "-o", tmp_path)
    status, out, err = run(capsys, *words, "--device", "opencl")
    assert status == 0, err
    for name in ("counts", "localisation", "views", "angles"):
        assert read_records(tmp_path / f"{name}.jsonl")
    text = (tmp_path / "report.md").read_text()
    assert "| AR Tag | - | - | 8" in text
    before = {file: file.read_bytes() for file in tmp_path.glob("*.jsonl")}
    status, out, _ = run(capsys, *words, "--json")  # nothing is left to do
    assert status == 0
    assert set(json.loads(out)["files"]) == {"counts", "localisation", "views", "angles"}
    assert {file: file.read_bytes() for file in tmp_path.glob("*.jsonl")} == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["angles", "--category", "tiny"], "unknown category 'tiny'"),
        (["angles", "--mixture", "boxes"], "unknown mixture 'boxes'"),
        (["angles", "--protocol", "P*"], "unknown protocol 'P*'; known: fixed-plane, fixed-module"),
        (["angles", "--tilts", "0-90"], "first:last:step"),
        (["angles", "--shard", "3/2", "--ideal"], "must be i/n"),
        (["angles", "--markers", "6"], "--markers must be 1 to 5, got 6"),
        (["angles", "--workers", "0"], "--workers must be at least 1 thread, got 0"),
        (
            ["views", "--trained", "nowhere"],
            "--trained must be a folder with models such as 2dgs-17/small-0.ply",
        ),
        (["counts", "--category", "huge", "--markers", "0"], "--markers must be 1 to 5, got 0"),
        (["blender", "--environment", "nowhere"], "fidsplat experiment blender --install"),
        (["blender", "--samples", "0"], "--samples must be at least 1, got 0"),
        (["blender", "--threads", "0"], "--threads must be at least 1, got 0"),
        (["views", "--trained", "."], "at least one of the folders 2dgs-3, 2dgs-5, 2dgs-9 and 2dgs-17"),
        (["localisation", "--category", "huge"], "--category must be apriltag or small, got huge"),
        (
            ["views", "--blender", "nowhere"],
            "--blender must be a folder that `fidsplat experiment blender`",
        ),
        (["blender", "--view", "agx"], "unknown view 'agx'"),
        (["merge", "nowhere"], "must contain results of shards, got nowhere"),
        (["report", "nowhere"], "results must be in nowhere, got none"),
    ],
)
def test_wrong_arguments_are_one_line(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    status, out, err = run(capsys, *words)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert message in err


def test_a_folder_that_cannot_be_written_is_shown_before_the_work(capsys, tmp_path):
    (tmp_path / "file").write_text("x")
    status, _, err = run(capsys, "counts", "-o", tmp_path / "file" / "deeper")
    assert status == 2
    assert "cannot write into the folder" in err


def test_what_is_wrong_with_the_last_experiment_is_shown_before_the_first(capsys, tmp_path):
    """Counts are measured first, tilts last: nothing is measured for a run that would fail after hours."""
    words = ("all", "--quick", *SMALL, "--mixture", "fitted", "-o", tmp_path)
    old = '{"run": {"code": "older"}}\n{"key": {"tilts": "x"}, "result": {}}\n'
    (tmp_path / "angles.jsonl").write_text(old)
    status, _, err = run(capsys, *words)
    assert status == 2
    assert "angles.jsonl must be of the same versions and code" in err
    status, _, err = run(capsys, *words, "--lpips", "--overwrite")
    assert status == 2
    assert "lpips must be usable for --lpips" in err
    assert read_records(tmp_path / "counts.jsonl") == []
    assert (tmp_path / "angles.jsonl").read_text() == old  # --overwrite drops nothing for it


def test_trained_models_that_are_missing_are_shown_before_the_work(capsys, tmp_path):
    (tmp_path / "2dgs-9").mkdir()
    (tmp_path / "2dgs-9" / "apriltag-0.ply").touch()
    words = ("all", "--quick", "--trained", tmp_path, "-o", tmp_path / "out")
    status, _, err = run(capsys, *words)
    assert status == 2
    assert "small-0.ply must be a trained model, got no file; train it" in err
    ExperimentSettings(tmp_path, category=("apriltag",), markers=1, trained=tmp_path).check()


def test_merge_names_shards_that_are_missing(capsys, tmp_path):
    words = ("counts", *SMALL, "--shard", "1/3", "-o", tmp_path)
    assert run(capsys, *words)[0] == 0
    status, out, err = run(capsys, "merge", tmp_path, "-o", tmp_path / "out")
    assert status == 0
    assert "1 results of 1 files" in out
    assert err == "fidsplat: warning: counts: missing shard 2/3, 3/3\n"


def test_images_of_another_seed_are_not_the_truth(capsys, tmp_path):
    """Blender's images are found by their names, which do not include the seed."""
    record_images(tmp_path / "b", "raw", 0, 16)
    words = ("views", "--quick", *SMALL, "--blender", tmp_path / "b", "--seed", "1", "-o", tmp_path / "out")
    status, _, err = run(capsys, *words)
    assert status == 2
    assert "must have seed 1, got 0" in err
    with pytest.raises(fs.InputError, match="must have samples 64, got 16; give another folder"):
        record_images(tmp_path / "b", "raw", 0, 64)
    assert check_images(tmp_path / "b", "raw", 0) == {"seed": 0, "samples": 16}
    assert check_images(tmp_path / "b", "standard", 3) == {}


def test_experiments_follow_the_environment_variable_of_devices(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("FIDSPLAT_DEVICE", "nonsense")
    status, _, err = run(capsys, "localisation", "--quick", *SMALL, "-o", tmp_path)
    assert status == 2
    assert "unknown device 'nonsense'" in err
