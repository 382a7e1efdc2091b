"""`fidsplat tradeoff` as a command: how a run survives, own scenes, several devices, wrong words."""

import json
import re
import time
from dataclasses import replace

import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments.sweep import TimeLimit, read_records
from fidsplat.experiments.tradeoff import run, scenes
from fidsplat.experiments.tradeoff.scenes import NAMES, scene_names
from fidsplat.experiments.tradeoff.summary import load
from fidsplat.scenes.random_clouds import random_cloud

WORDS = ("tradeoff", "--quick", "--scenes", "apriltag", "--settings", "opacity_ceiling")


@pytest.mark.sweep
def test_an_interrupted_run_continues(capsys, tmp_path, monkeypatch):
    words = [*WORDS, "-o", str(tmp_path), "--json"]
    real, begun = run._begin, []

    def stopped(session, part, quick):
        begun.append(part)
        if len(begun) > 2:
            raise KeyboardInterrupt
        return real(session, part, quick)

    monkeypatch.setattr(run, "_begin", stopped)
    monkeypatch.setattr(run.TradeoffSettings, "workers", 1)
    # images of 200 x 200 pixels instead of 800 x 800
    monkeypatch.setattr(scenes, "PROTOCOL", replace(scenes.PROTOCOL, pixels=200))
    assert main(words) == 130
    out, err = capsys.readouterr()
    assert out == ""
    assert "interrupted" in err
    assert re.search(r"tradeoff on auto: \d+ points, about \d+ s", err)  # the estimate
    assert re.search(r"tradeoff on auto: 2 of \d+ points", err)  # what is measured so far
    assert re.search(r"^base +base +2 +\d", err, re.MULTILINE)
    file = tmp_path / run.FILE
    first = file.read_text()
    assert [record.key for record in read_records(file)] == begun[:2]

    monkeypatch.setattr(run, "_begin", real)
    assert main(words) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"files": [str(file)], "points": len(read_records(file)), "refused": []}
    assert file.read_text().startswith(first)
    records = read_records(file)
    # an installed package has no commit
    assert all(record.run["device"] and record.run["code"] and "commit" in record.run for record in records)

    before = file.read_bytes()
    assert main(words) == 0  # nothing is left to do
    assert file.read_bytes() == before


def test_a_quick_run_stops_in_time_and_continues(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "QUICK_SECONDS", 0.0)
    monkeypatch.setattr(run, "estimated_seconds", lambda session, keys, effort: 200.0)
    words = [*WORDS, "-o", str(tmp_path)]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "about 3 min 20 s; --quick stops after 0 s, the same command continues" in err
    total = int(re.search(r"(\d+) of \1 points are not measured yet", out)[1])
    assert read_records(tmp_path / run.FILE) == []

    monkeypatch.setattr(run, "QUICK_SECONDS", 150.0)
    monkeypatch.setattr(run, "_begin", lambda session, key, quick: lambda: {"ratio": 1.0, "maximum": 0.1})
    assert main(words) == 0
    assert "not measured yet" not in capsys.readouterr().out
    assert len(read_records(tmp_path / run.FILE)) == total


def test_a_scene_that_a_device_refuses_does_not_stop_the_estimate(monkeypatch):
    def refuse(self, view, quality):
        raise fs.DeviceError("no memory for this")

    monkeypatch.setattr(run.Session, "render", refuse)
    keys = run.all_points(("hard",), ("alpha_cutoff",), True)
    session = run.Session(fs.Renderer("opencl:pocl"))
    assert 0 < run.estimated_seconds(session, keys, run.QUICK) < 60


def test_no_batch_begins_that_would_exceed_the_limit(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    limit = TimeLimit(100.0)
    for seconds in (10.0, 30.0, 20.0):
        assert limit.allows()
        with limit.batch():
            now[0] += seconds
    assert limit.allows()  # 60 s passed, at most 30 s more
    now[0] += 10.0
    assert not limit.allows()


def test_ones_own_scene_is_measured_from_each_of_its_poses(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene_file = tmp_path / "own.toml"
    fs.save_ply(random_cloud(200, 0.2), "own.ply")
    scene_file.write_text(
        "[camera]\nwidth = 64\nheight = 48\nfov_x_deg = 60.0\nposition = [0.0, 0.0, 0.0]\n"
        'look_at = [0.0, 0.0, 1.0]\n[[splats]]\nfile = "own.ply"\n'
    )
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n1 0.1 0 0 0 0 0 1\n2 0.2 0 0 0 0 0 1\n")
    words = ["tradeoff", "--quick", "--scene", "own.toml", "--cameras", "poses.tum", "-o", "out"]
    words += ["--knobs", "opacity_ceiling"]
    assert main(words) == 0
    records = read_records(tmp_path / "out" / run.FILE)
    views = ("own.toml@0", "own.toml@2")  # --quick measures two
    actual = {(r.key["scene"], r.key["value"]): r.result for r in records}
    assert {key[0] for key in actual} == set(views)
    for view in views:
        assert 1e-4 < actual[view, "base"]["maximum"] < 0.05
    # images differ, so do their errors; the ceiling lets light through
    assert actual[views[0], "base"]["rmse"] != actual[views[1], "base"]["rmse"]
    assert actual[views[0], "0.99"]["maximum"] >= actual[views[0], "base"]["maximum"]
    capsys.readouterr()
    assert load([tmp_path / "out"])[0].scenes == list(views)
    assert main(words) == 0  # nothing is left to do
    fs.save_ply(random_cloud(201, 0.2), "own.ply")
    assert main(words) == 2
    assert "must be of the same scene, got others; give another folder" in capsys.readouterr().err
    assert main(["tradeoff", "--scene", "own.toml", "--scenes", "hard"]) == 2
    assert "must not be given together" in capsys.readouterr().err


def test_several_devices_measure_into_folders_of_their_names(capsys, tmp_path, monkeypatch):
    actual = {
        "ratio": 1.0,
        "ratio_quartiles": [0.9, 1.1],
        "base_ms": 2.0,
        "maximum": 0.01,
        "maximum_sure": 0.01,
    }
    begun = []

    def begin(session, key, quick):
        begun.append(session.renderer.device.name)
        return lambda: {**actual, "read": "1" * 50}

    monkeypatch.setattr(run, "_begin", begin)
    words = ["tradeoff", "--quick", "--scenes", "hard", "--knobs", "opacity_ceiling", "-o", str(tmp_path)]
    words += ["--device", "opencl:pocl", "--device", "warp:cpu"]
    assert main([*words, "--plot", str(tmp_path / "times.pdf")]) == 2
    assert "--plot must be a file that ends in .svg or .png" in capsys.readouterr().err
    assert main([*words[:-1], "opencl:nowhere"]) == 2
    assert not begun  # a device that is not there is said first
    capsys.readouterr()
    assert main([*words, "--plot", str(tmp_path / "both.svg"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["files"] == [str(tmp_path / name / run.FILE) for name in ("opencl-pocl", "warp-cpu")]
    records = [read_records(tmp_path / name / run.FILE) for name in ("opencl-pocl", "warp-cpu")]
    assert printed["points"] == len(begun) == sum(map(len, records))
    assert begun == ["opencl:pocl"] * len(records[0]) + ["warp:cpu"] * len(records[1])
    titles = [device.title for device in load([tmp_path / "opencl-pocl", tmp_path / "warp-cpu"])]
    chart = (tmp_path / "both.svg").read_text()
    assert len(set(titles)) == 2
    assert all(f"<!-- hard on {title} -->" in chart for title in titles)


def test_what_a_device_refuses_is_a_result(tmp_path, monkeypatch):
    def refuse(*_):
        raise fs.InputError("no such thing here")

    monkeypatch.setattr(run, "_begin", refuse)
    settings = run.TradeoffSettings(("apriltag",), ("samples",), quick=True)
    with run.prepared(settings, tmp_path, "opencl") as sweep:
        records = list(sweep.run())
    assert records
    assert all(record.result == {"error": "no such thing here"} for record in records)

    # it may have been the device that failed: another run tries again
    monkeypatch.setattr(run, "_begin", lambda *_: lambda: {"maximum": 0.0})
    for left in (len(records), 0):
        with run.prepared(settings, tmp_path, "opencl") as sweep:
            assert len(sweep.left) == len(list(sweep.run())) == left
    assert [record.result for record in read_records(tmp_path / run.FILE)] == [{"maximum": 0.0}] * len(
        records
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenes", "qr11"], "unknown scene 'qr11' (did you mean 'qr10'?)"),
        (["--settings", "alpha_cutof"], "unknown setting 'alpha_cutof' (did you mean 'alpha_cutoff'?)"),
        (["--device", "reference"], "must be another device than reference"),
    ],
)
def test_wrong_arguments_are_one_line(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(["tradeoff", *words]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert message in err


def test_help_teaches(capsys):
    assert main(["tradeoff", "--help"]) == 0
    out = capsys.readouterr().out
    assert "usage: fidsplat tradeoff" in out
    assert "  fidsplat tradeoff -o gpu --device opencl:nvidia" in out


def test_names_of_scenes():
    assert scene_names(()) == NAMES
    assert scene_names(("hard", "hard")) == ("hard",)
