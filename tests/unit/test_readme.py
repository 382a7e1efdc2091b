"""What the README promises word for word."""

import re
from pathlib import Path

import numpy as np
import pytest

import fidsplat as fs

TREE = Path(__file__).resolve().parents[2]
README = (TREE / "README.md").read_text("utf-8")


@pytest.mark.parametrize("line", ["pip install . && fidsplat demo", "pip install '.[test]' && pytest"])
def test_the_two_commands_stand_there(line):
    assert line in README.splitlines()


def test_every_link_and_picture_is_there():
    for page in [TREE / "README.md", *sorted((TREE / "docs").glob("*.md"))]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text("utf-8")):
            assert (page.parent / target).exists(), f"{page.name} points at {target}"


def test_the_python_example_runs(tmp_path, monkeypatch, capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert 8 <= len([line for line in example.splitlines() if line.strip()]) <= 11
    monkeypatch.chdir(tmp_path)
    far = np.array([[0.0, 0.0, 3.0]])
    room = fs.SplatCloud(far, [[1.0, 0, 0, 0]], [[1.0, 1.0]], [0.9], colors=[[0.7, 0.6, 0.5]])
    fs.save_ply(room, "room.ply")
    exec(compile(example, "README.md", "exec"), {})
    assert "apriltag:36h11:5" in capsys.readouterr().out
