"""Sweeps survive interrupts, shards and other machines."""

import json
import math
from pathlib import Path

import pytest

import fidsplat as fs
from fidsplat.experiments.sweep import (
    Results,
    Sweep,
    merge,
    missing_shards,
    read_records,
    shard,
    thread_pool,
)
from fidsplat.util.provenance import run_facts

POINTS = [{"category": "small", "index": i} for i in range(5)]


def facts(**changes) -> dict:
    return run_facts("a device", 0, {"opencv": "5"}) | changes


def sweep(file, measure=lambda key: {}, points=POINTS, overwrite=False, **changes) -> Sweep:
    results = Results(file, facts(**changes), overwrite)
    return Sweep("counts", results, points, lambda key: lambda: measure(key))


def test_a_run_that_was_stopped_continues(tmp_path):
    file = tmp_path / "deep" / "counts.jsonl"
    requested = []

    def measure(key):
        requested.append(key["index"])
        if len(requested) == 3:
            raise KeyboardInterrupt
        return {"value": key["index"] ** 2}

    with pytest.raises(KeyboardInterrupt):
        list(sweep(file, measure).run())
    assert [record.result["value"] for record in read_records(file)] == [0, 1]
    with open(file, "a") as stream:
        stream.write('{"key": {"category": "small", "ind')  # as a power cut leaves it

    again = sweep(file, measure)
    assert again.left == POINTS[2:]
    assert [record.key["index"] for record in again.run()] == [2, 3, 4]
    assert requested == [0, 1, 2, 2, 3, 4]
    records = read_records(file)
    assert [record.key for record in records] == POINTS
    assert [record.result["value"] for record in records] == [0, 1, 4, 9, 16]
    assert all(record.run == facts() for record in records)


def test_facts_of_a_run_are_written_once(tmp_path):
    file = tmp_path / "counts.jsonl"
    list(sweep(file, points=POINTS[:2]).run())
    list(sweep(file, points=POINTS[:3]).run())
    list(sweep(file, date="2030-01-01").run())
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert [sorted(line) for line in lines].count(["run"]) == 2
    assert [record.run["date"] for record in read_records(file)] == [facts()["date"]] * 3 + ["2030-01-01"] * 2


def test_a_batch_is_begun_before_its_first_end(tmp_path):
    """Evaluation of images on the host must not disturb timing."""
    order = []

    def begin(key):
        order.append(("begin", key["index"]))
        return lambda: order.append(("end", key["index"])) or {}

    list(Sweep("counts", Results(tmp_path / "a.jsonl", facts()), POINTS[:3], begin, batch=2).run())
    assert order == [("begin", 0), ("begin", 1), ("end", 0), ("end", 1), ("begin", 2), ("end", 2)]


def test_with_overlap_a_batch_is_begun_before_the_results_of_the_last_one_are_written(tmp_path):
    file = tmp_path / "a.jsonl"
    written = []

    def begin(key):
        written.append(len(read_records(file)))
        return lambda: {"value": key["index"]}

    with thread_pool(2) as pool:
        sweep = Sweep("counts", Results(file, facts()), POINTS[:5], begin, 2, pool, overlap=True)
        actual = [record.result["value"] for record in sweep.run()]
    assert actual == [point["index"] for point in POINTS[:5]]
    assert written == [0, 0, 0, 0, 2]


def test_a_point_that_was_refused_is_tried_again(tmp_path):
    file = tmp_path / "counts.jsonl"
    (record,) = sweep(file, lambda key: {"error": "no halves here"}, POINTS[:1]).run()
    assert record.failed
    assert read_records(file) == [record]
    list(sweep(file, lambda key: {"value": 1}, POINTS[:1]).run())
    assert [record.result for record in read_records(file)] == [{"value": 1}]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"device": "another device"}, "the same device,"),
        ({"seed": 1}, "the same seed,"),
        ({"code": "0" * 16}, "the same code,"),
        ({"versions": {"opencv": "6"}}, "the same versions,"),
    ],
)
def test_results_of_other_circumstances_are_not_mixed(tmp_path, changes, named):
    file = tmp_path / "counts.jsonl"
    list(sweep(file).run())
    before = file.read_bytes()
    with pytest.raises(fs.InputError, match=named):
        sweep(file, **changes)
    assert file.read_bytes() == before
    assert len(sweep(file, overwrite=True, **changes).left) == 5
    assert read_records(file) == []


def test_experiments_without_rendering_resume_on_any_device(tmp_path):
    file = tmp_path / "angles.jsonl"
    list(sweep(file, points=POINTS[:2], device=None).run())
    with_device = sweep(file)
    assert len(with_device.left) == 3
    list(with_device.run())
    assert sweep(file, device=None).left == []


def test_another_commit_or_day_does_not_matter(tmp_path):
    file = tmp_path / "counts.jsonl"
    list(sweep(file).run())
    assert sweep(file, commit="other", date="2030-01-01").left == []


def test_a_disk_that_is_full_is_not_reported_as_a_bug(tmp_path):
    file = tmp_path / "counts.jsonl"
    running = sweep(file)
    running.results.append(POINTS[0], {"value": 1.0})
    contents = file.read_bytes()
    file.unlink()
    file.symlink_to("/dev/full")
    with pytest.raises(fs.InputError, match=r"counts.jsonl: No space left on device; .* resumes from them"):
        running.results.append(POINTS[1], {"value": 2.0})
    file.unlink()
    file.write_bytes(contents + b'{"key": {"category":')  # as far as there was room
    assert sweep(file).left == POINTS[1:]


def test_a_result_that_is_not_json_is_a_bug_and_not_written(tmp_path):
    file = tmp_path / "counts.jsonl"
    with pytest.raises(ValueError, match="not JSON compliant"):
        list(sweep(file, lambda key: {"value": math.nan}).run())
    assert read_records(file) == []


def test_numbers_have_six_digits(tmp_path):
    (record,) = sweep(tmp_path / "a.jsonl", lambda key: {"a": [1 / 3, {"b": 2e-7 / 3}]}, POINTS[:1]).run()
    assert record.result == {"a": [0.333333, {"b": 6.66667e-08}]}
    assert read_records(tmp_path / "a.jsonl") == [record]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('{"run": {}}\nmilk, bread\n', 2),
        ('{"key": {}, "result": {}}\n', 1),
        ('{"run": 1}\n{"key": {}, "result": {}}\n', 2),
        ('{"run": {}}\n{"key": {}, "result": {"a": 1e999}}\n', 2),
        ('{"run": {}}\n{"key": {}, "result": {"a": NaN}}\n', 2),
        ('{"run": {}}\n' + "[" * 100_000 + "\n", 2),
    ],
)
def test_files_that_are_not_ours_are_refused_and_unchanged(tmp_path, text, line):
    file = tmp_path / "notes.jsonl"
    file.write_text(text)
    with pytest.raises(fs.InputError, match=f"line {line}: not a result"):
        sweep(file)
    assert file.read_text() == text


def test_shards_share_the_work():
    parts = [shard(POINTS, f"{i}/3") for i in (1, 2, 3)]
    assert sorted(p["index"] for part in parts for p in part) == [0, 1, 2, 3, 4]
    assert [len(part) for part in parts] == [2, 2, 1]
    assert shard(POINTS, None) == POINTS
    for text in ("0/3", "4/3", "1", "a/b", "1/0", "-1/3", "", "²/3"):
        with pytest.raises(fs.InputError, match="--shard must be i/n with 1 <= i <= n"):
            shard(POINTS, text)


def test_merge_joins_shards_and_counts_repeats(tmp_path):
    files = [tmp_path / f"counts-{i}-of-2.jsonl" for i in (1, 2)]
    for number, file in enumerate(files):
        list(sweep(file, lambda key, by=number: {"by": by}, POINTS[2 * number : 2 * number + 3]).run())
    target = tmp_path / "out" / "counts.jsonl"
    assert merge(files, target) == (5, 1, ())
    assert {r.key["index"]: r.result["by"] for r in read_records(target)} == {0: 0, 1: 0, 2: 0, 3: 1, 4: 1}
    assert merge([target, *files], target) == (5, 6, ())
    with pytest.raises(fs.InputError, match=r"must be \.jsonl files"):
        merge([tmp_path / "none.jsonl"], target)


def test_merging_one_machine_after_the_other_loses_nothing_and_says_what_differs(tmp_path):
    target = tmp_path / "counts.jsonl"
    for number, device in enumerate((None, "a device", "another")):
        file = tmp_path / f"counts-{number + 1}-of-4.jsonl"
        points = [POINTS[0], *POINTS[number : number + 1]][: 1 + bool(number)]
        list(sweep(file, lambda key, by=number: {"by": by}, points, device=device).run())
        assert merge([file], target) == (number + 1, 0, ("device",) if number == 2 else ())
    # a shard that was measured again replaces what was merged of it before
    assert {r.key["index"]: r.result["by"] for r in read_records(target)} == {0: 2, 1: 1, 2: 2}
    assert [r.run["device"] for r in read_records(target)].count("a device") == 1
    other = tmp_path / "counts-4-of-4.jsonl"
    list(sweep(other, points=POINTS[3:], code="0" * 16, seed=1).run())
    assert merge([other], target).differ == ("code", "device", "seed")


def test_missing_shards_are_named():
    files = [Path(f"a/angles-{i}-of-4.jsonl") for i in (1, 4)] + [Path("b/angles-2-of-2.jsonl")]
    assert missing_shards([*files, Path("angles.jsonl")]) == ["1/2", "2/4", "3/4"]
    assert missing_shards(files[:2] + [Path(f"b/angles-{i}-of-4.jsonl") for i in (2, 3)]) == []
