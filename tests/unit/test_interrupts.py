"""Signals and full disks: the short form of tools/interrupt.py."""

import os
import random

import interrupt
import pytest

NOTHING_LOST = {"broken": 0, "unclear": 0, "changed": 0}


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return interrupt.Trial("render", tmp_path_factory.mktemp("interrupted"))


def lost(tally):
    return {name: getattr(tally, name) for name in NOTHING_LOST}


def test_an_interrupted_command_loses_nothing(trial, tmp_path):
    tally = interrupt.kills(trial, tmp_path, 6, random.Random(3))
    assert tally.interrupted >= 1
    assert lost(tally) == NOTHING_LOST


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount a small file system")
def test_a_full_disk_loses_nothing(trial, tmp_path):
    probe = tmp_path / "probe"
    try:
        with interrupt.small_disk(probe, 2**20):
            pass
    except interrupt.subprocess.CalledProcessError:
        pytest.skip("no file system can be mounted here")
    tally = interrupt.disks(trial, tmp_path, 2)
    assert tally.interrupted == 2
    assert lost(tally) == NOTHING_LOST


def test_what_is_cut_off_is_seen(tmp_path):
    whole = tmp_path / "figures.json"
    whole.write_text('{"a": 1}\n')
    assert interrupt.is_whole(whole)
    whole.write_text('{"a": ')
    assert not interrupt.is_whole(whole)
    log = tmp_path / "rows.jsonl"
    log.write_text('{"a": 1}\n{"a": ')
    assert interrupt.is_whole(log)
    log.write_text('{"a": 1\n{"a": 2}\n')
    assert not interrupt.is_whole(log)
