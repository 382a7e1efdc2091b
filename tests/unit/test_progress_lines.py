"""Progress of commands whose stderr is no terminal: a line every so many seconds."""

import re
import subprocess
import sys
import time

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.commands import progress_lines
from fidsplat.commands.output import console, delayed_progress, show_progress, steps_shown
from fidsplat.commands.progress_lines import ProgressLines, duration, line_of


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(progress_lines, "PERIOD", 0.02)


@pytest.mark.usefixtures("often")
def test_lines_count_the_steps(capsys):
    def steps():
        for k in range(4):
            time.sleep(0.05)
            yield k

    assert list(show_progress("frames", steps(), 6, done=2, label=lambda k: f"no. {k}")) == [0, 1, 2, 3]
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert lines[0] == "frames: 2 of 6"  # nothing is done yet: no estimate
    assert any(re.fullmatch(r"frames no\. 1: 4 of 6, \d+ s left", line) for line in lines)
    time.sleep(0.05)
    assert capsys.readouterr().err == ""  # it ends with the work


@pytest.mark.usefixtures("often")
def test_long_work_between_two_calls_is_reported(capsys):
    with delayed_progress(after=0.0) as progress:
        progress("reading room.ply", 0.25)
        time.sleep(0.2)
    assert re.search(r"^reading room.ply: 25 %, \d+ s left$", capsys.readouterr().err, re.MULTILINE)
    with delayed_progress(after=60.0) as progress:
        progress("reading tag.ply", 0.25)
        time.sleep(0.1)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("often")
def test_work_of_unknown_length_shows_its_step(capsys):
    with steps_shown(console(True), "starting") as update:
        update("measuring samples=2")
        time.sleep(0.1)
    assert re.search(r"^measuring samples=2: \d s so far$", capsys.readouterr().err, re.MULTILINE)


def test_the_time_left_is_that_of_this_run():
    now = [0.0]
    bar = ProgressLines()
    bar.get_time = lambda: now[0]
    task = bar.add_task("training", total=7000, completed=2000, now="")
    for now[0], completed in ((0.0, 2000), (30.0, 2500), (60.0, 3000)):
        bar.update(task, completed=completed, now="loss 0.0412")
    # 1000 in a minute, 4000 are left; the first 2000 are of an earlier run
    assert line_of(bar.tasks[0]) == "training: 3,000 of 7,000, 4 min 0 s left (loss 0.0412)"


def test_durations():
    assert [duration(s) for s in (0.2, 59, 60, 725, 3600, 12_000)] == [
        *("0 s", "59 s", "1 min 0 s", "12 min 5 s", "1 h 0 min", "3 h 20 min")
    ]


@pytest.mark.usefixtures("often")
def test_a_flight_prints_lines_next_to_its_json(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    count = 30
    cloud = fs.SplatCloud(
        np.random.default_rng(0).uniform(-1, 1, (count, 3)),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 2), 0.2),
        np.ones(count),
        colors=np.ones((count, 3)),
    )
    fs.save_ply(cloud, "few.ply")
    (tmp_path / "path.tum").write_text("".join(f"{k} 0 0 {-4 - k} 0 0 0 1\n" for k in range(6)))
    words = ["--trajectory", "path.tum", "--rate", "1", "--size", "24", "18", "--device", "reference"]
    assert main(["fly", "few.ply", *words, "--json"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("{")
    assert re.search(r"^frames: \d of 6", err, re.MULTILINE)


def test_a_closed_stderr_does_not_stop_the_work():
    program = (
        "import sys, time\n"
        "from fidsplat.commands import progress_lines as p\n"
        "p.PERIOD = 0.01\n"
        "sys.stderr.close()\n"
        "with p.ProgressLines() as bar:\n"
        "    bar.add_task('work', total=2)\n"
        "    time.sleep(0.1)\n"
        "print('done')\n"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "done\n"
