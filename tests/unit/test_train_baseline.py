"""The paper's baseline: trainings of markers, which stop, go on and are not mixed."""

from dataclasses import replace

import pytest
from training_scene import scene, write

import fidsplat as fs


@pytest.fixture
def folder(tmp_path):
    write(scene(count=6), tmp_path / "set")
    return tmp_path / "set"


def test_the_baseline_of_a_marker(folder, tmp_path, monkeypatch):
    """Its splats stand where `experiment views --trained` looks; what was stopped goes on."""
    from fidsplat.experiments import trained

    monkeypatch.setattr(trained, "write_scene", lambda *_: folder)
    point = {"category": "small", "index": 2, "views": 9, "iterations": 2, "seed": 0}
    renderer, steps = fs.Renderer("reference"), []
    found = trained.train_marker(point, tmp_path, tmp_path / "out", 0, renderer, steps.append)
    assert [step.iteration for step in steps] == [1, 2]
    assert (found["splats"], found["iterations"]) == (6, 2)
    assert found["psnr"] > 5
    assert [each.name for each in (tmp_path / "out").rglob("*.*")] == ["small-2.ply"]
    first = tmp_path / "out" / "2dgs-9" / "small-2.ply"
    trained.train_marker(point | {"seed": 1}, tmp_path, tmp_path / "out", 0, renderer)
    other = tmp_path / "out" / "seed-1" / "2dgs-9" / "small-2.ply"
    assert first.read_bytes() != other.read_bytes()


def test_the_baseline_trained_again_forgets_what_was_stopped(folder, tmp_path, monkeypatch):
    from fidsplat.experiments import trained

    monkeypatch.setattr(trained, "write_scene", lambda *_: folder)
    point, renderer = {"category": "small", "index": 2, "views": 9, "seed": 0}, fs.Renderer("reference")

    def stop(step):
        if step.iteration == 3:  # the checkpoint is of the second
            raise KeyboardInterrupt

    monkeypatch.setattr("fidsplat.train.trainer.CHECKPOINT_SECONDS", -1.0)
    steps = []
    with pytest.raises(KeyboardInterrupt):
        trained.train_marker(point | {"iterations": 3}, tmp_path, tmp_path, 0, renderer, stop)
    assert (tmp_path / "2dgs-9" / "small-2.training.npz").is_file()
    words = (tmp_path, tmp_path, 0, renderer, steps.append)
    with pytest.raises(fs.InputError, match="another number of iterations"):
        trained.train_marker(point | {"iterations": 1}, *words)
    found = trained.train_marker(point | {"iterations": 1}, *words, restart=True)
    assert found["iterations"] == len(steps) == 1


def test_the_baseline_of_other_iterations_is_not_mixed_in(tmp_path):
    """What it looks like and how far it is read would stay that of the first splats."""
    from fidsplat.experiments.trained import BaselineSettings, baseline_sweeps

    renderer = fs.Renderer("reference")
    expected = BaselineSettings(tmp_path, category=("small",), markers=1, views=(3,), iterations=5)
    with baseline_sweeps(expected, renderer) as (trainings, *_):
        trainings.results.append(expected.points[0], {"psnr": 30.0})
    with pytest.raises(fs.InputError, match=r"holds trainings of 5 iterations, not 7; .* --overwrite"):
        baseline_sweeps(replace(expected, iterations=7), renderer).__enter__()
    with baseline_sweeps(expected, renderer) as (trainings, *_):
        assert trainings.left == []
    with baseline_sweeps(replace(expected, iterations=7, overwrite=True), renderer) as (trainings, *_):
        assert len(trainings.left) == 1


def test_the_baseline_begins_with_one_marker_of_each_category(tmp_path):
    """So that a run that is stopped says something of all; what is shared among machines is all of it."""
    from fidsplat.experiments.setup import CATEGORIES
    from fidsplat.experiments.trained import BaselineSettings

    expected = BaselineSettings(tmp_path, markers=2, seeds=3)
    assert len(expected.points) == 5 * 2 * 4 * 3
    first = expected.points[:20]
    assert {(p["category"], p["views"]) for p in first} == {(c, n) for c in CATEGORIES for n in (3, 5, 9, 17)}
    assert {(p["index"], p["seed"]) for p in first} == {(0, 0)}
    shares = [replace(expected, shard=f"{i}/7").points for i in range(1, 8)]
    assert sorted(map(str, expected.points)) == sorted(str(p) for share in shares for p in share)
    assert replace(expected, shard="2/7").file("views").name == "views-2-of-7.jsonl"
