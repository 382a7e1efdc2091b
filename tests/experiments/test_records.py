"""Results that survive interrupts, shards and other machines."""

import math
from pathlib import Path

import pytest

import fidsplat as fs
from fidsplat.experiments.records import Records, merge, missing_shards, read_lines, shard
from fidsplat.provenance import run_facts

WORK = [{"category": "small", "index": i} for i in range(5)]


def facts(**changes) -> dict:
    return run_facts("a device", 0, {"opencv": "5"}) | changes


def test_a_run_that_was_stopped_goes_on(tmp_path):
    file = tmp_path / "deep" / "counts.jsonl"
    asked = []

    def measure(part):
        asked.append(part["index"])
        if len(asked) == 3:
            raise KeyboardInterrupt
        return {"value": part["index"] ** 2}

    with pytest.raises(KeyboardInterrupt):
        list(Records(file, facts()).measure(WORK, measure))
    assert [line["result"]["value"] for line in read_lines(file)] == [0, 1]
    with open(file, "a") as stream:
        stream.write('{"key": {"category": "small", "ind')  # as a power cut leaves it

    records = Records(file, facts())
    assert records.missing(WORK) == 3
    done = [count for count, _ in records.measure(WORK, measure)]
    assert asked == [0, 1, 2, 2, 3, 4]
    assert done == [1, 2, 3, 4, 5]
    lines = read_lines(file)
    assert [line["key"] for line in lines] == WORK
    assert [line["result"]["value"] for line in lines] == [0, 1, 4, 9, 16]
    assert all(line["run"] == facts() for line in lines)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"device": "another device"}, "another device;"),
        ({"seed": 1}, "another seed;"),
        ({"code": "0" * 16}, "another code;"),
        ({"versions": {"opencv": "6"}}, "another versions;"),
    ],
)
def test_results_of_other_circumstances_are_not_mixed(tmp_path, changes, named):
    file = tmp_path / "counts.jsonl"
    list(Records(file, facts()).measure(WORK, lambda part: {}))
    before = file.read_bytes()
    with pytest.raises(fs.InputError, match=named):
        Records(file, facts(**changes))
    assert file.read_bytes() == before
    assert Records(file, facts(**changes), anew=True).missing(WORK) == 5
    assert read_lines(file) == []


def test_what_draws_nothing_goes_with_any_device(tmp_path):
    file = tmp_path / "angles.jsonl"
    list(Records(file, facts(device=None)).measure(WORK[:2], lambda part: {}))
    records = Records(file, facts(device="a device"))
    assert records.missing(WORK) == 3
    list(records.measure(WORK, lambda part: {}))
    assert Records(file, facts(device=None)).missing(WORK) == 0


def test_another_commit_or_day_does_not_matter(tmp_path):
    file = tmp_path / "counts.jsonl"
    list(Records(file, facts()).measure(WORK, lambda part: {}))
    assert Records(file, facts(commit="other", date="2030-01-01")).missing(WORK) == 0


def test_a_result_that_is_no_json_is_a_fault_and_not_written(tmp_path):
    file = tmp_path / "counts.jsonl"
    with pytest.raises(ValueError, match="not JSON compliant"):
        list(Records(file, facts()).measure(WORK, lambda part: {"value": math.nan}))
    assert read_lines(file) == []


def test_files_that_are_not_ours_are_refused_and_left_alone(tmp_path):
    file = tmp_path / "notes.jsonl"
    file.write_text('{"key": {}, "result": {}}\nmilk, bread\n')
    with pytest.raises(fs.InputError, match="line 2: not a result"):
        Records(file, facts())
    assert "milk" in file.read_text()


def test_shards_share_the_work():
    parts = [shard(WORK, f"{i}/3") for i in (1, 2, 3)]
    assert sorted(p["index"] for part in parts for p in part) == [0, 1, 2, 3, 4]
    assert [len(part) for part in parts] == [2, 2, 1]
    assert shard(WORK, None) == WORK
    for text in ("0/3", "4/3", "1", "a/b", "1/0", "-1/3", "", "²/3"):
        with pytest.raises(fs.InputError, match="write i/n with 1 <= i <= n"):
            shard(WORK, text)


def test_merge_joins_shards_and_counts_repeats(tmp_path):
    files = [tmp_path / f"counts-{i}-of-2.jsonl" for i in (1, 2)]
    for number, file in enumerate(files):
        list(Records(file, facts()).measure(WORK[2 * number : 2 * number + 3], lambda part: {"by": number}))  # noqa: B023
    target = tmp_path / "out" / "counts.jsonl"
    assert merge(files, target) == (5, 1, ())
    lines = {line["key"]["index"]: line["result"]["by"] for line in read_lines(target)}
    assert lines == {0: 0, 1: 0, 2: 0, 3: 1, 4: 1}
    assert merge([target, *files], target) == (5, 6, ())
    with pytest.raises(fs.InputError, match="is not a file"):
        merge([tmp_path / "none.jsonl"], target)


def test_merging_one_machine_after_the_other_loses_nothing_and_says_what_differs(tmp_path):
    target = tmp_path / "counts.jsonl"
    for number, device in enumerate((None, "a device", "another")):
        file = tmp_path / f"counts-{number + 1}-of-4.jsonl"
        records, by = Records(file, facts(device=device)), {"by": number}
        list(records.measure([WORK[0], WORK[number]], lambda part, by=by: by))
        joined = merge([file], target)
        assert joined == (number + 1, 0, ("device",) if number == 2 else ())
    # a shard that was measured anew replaces what was merged of it before
    assert {line["key"]["index"]: line["result"]["by"] for line in read_lines(target)} == {0: 2, 1: 1, 2: 2}
    other = tmp_path / "counts-4-of-4.jsonl"
    list(Records(other, facts(code="0" * 16, seed=1)).measure(WORK[3:], lambda part: {}))
    assert merge([other], target).differ == ("code", "device", "seed")


def test_missing_shards_are_named():
    files = [Path(f"a/angles-{i}-of-4.jsonl") for i in (1, 4)] + [Path("b/angles-2-of-2.jsonl")]
    assert missing_shards([*files, Path("angles.jsonl")]) == ["1/2", "2/4", "3/4"]
    assert missing_shards(files[:2] + [Path(f"b/angles-{i}-of-4.jsonl") for i in (2, 3)]) == []
