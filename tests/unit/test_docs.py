"""What the README and the pages of docs/ print works as printed: their Python runs, their scene files load,
their command lines parse, their links lead somewhere."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from sybil import Sybil
from sybil.example import Example
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser

import fidsplat as fs
from fidsplat.cli import _parse
from fidsplat.vision.images import read_image

TREE = Path(__file__).resolve().parents[2]
README = TREE / "README.md"
EXAMPLES = TREE / "examples"
PAGES = [README, TREE / "CONTRIBUTING.md", *sorted((TREE / "docs").glob("*.md"))]
DEVLOG = sorted((TREE / "devlog").glob("*.md"))
GIVEN = {
    "large-scenes.md",
    "README.md",
    "rendering.md",
    "scene-files.md",
}  # their blocks read a room.ply, which readers have


def load_scene(example: Example) -> None:
    """A scene file is kept under the name in its first comment, else scene.toml, for later blocks."""
    name = re.match(r"# (\S+\.toml)", example.parsed)
    path = Path(name[1] if name else "scene.toml")
    path.write_text(example.parsed, "utf-8")
    fs.Scene.load(path)


def check_commands(text: str) -> None:
    """Every `fidsplat` parses, and every script that Python is to run is there."""
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.shlex(line, posix=True, punctuation_chars=";&|>")
        words.whitespace_split = True
        command: list[str] = []
        for word in [*words, ";"]:
            if set(word) <= set(";&|>"):
                check_command(command)
                command = []
            elif word != "do" and not re.fullmatch(r"[A-Z_]+=\S*", word):
                command.append(word)


def check_command(words: list[str]) -> None:
    if words[:1] == ["fidsplat"]:
        _parse(words[1:])
    elif words[:1] == ["python"] and words[1].endswith(".py"):
        assert (TREE / words[1]).exists(), f"{words[1]} is not there"


BLOCKS = Sybil(
    [
        PythonCodeBlockParser(),
        SkipParser(),
        CodeBlockParser("toml", load_scene),
        CodeBlockParser("bash", lambda example: check_commands(example.parsed)),
    ]
)


def given_room() -> None:
    """A splat file such as a reader has, kept as room.ply."""
    far = np.array([[0.0, 0.0, 3.0]])
    room = fs.SplatCloud(far, [[1.0, 0, 0, 0]], [[1.0, 1.0]], [0.9], colors=[[0.7, 0.6, 0.5]])
    fs.save_ply(room, "room.ply")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_blocks_work_as_printed(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page.name in GIVEN:
        given_room()
    for example in BLOCKS.parse(page).examples():
        example.evaluate()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_says_its_language(page):
    """So that none is passed over by the test above: text, or what that test knows."""
    known = {"python", "toml", "bash", "text"}
    fences = re.findall(r"^ *```(.*)$", page.read_text("utf-8"), re.MULTILINE)
    assert set(fences[::2]) <= known
    assert set(fences[1::2]) <= {""}


@pytest.mark.parametrize("page", [*PAGES, *DEVLOG], ids=lambda page: page.name)
def test_every_link_and_picture_is_there(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text("utf-8")):
        assert (page.parent / target).exists(), f"{page.name} points at {target}"


@pytest.mark.parametrize("line", ["pip install . && fidsplat demo", "pip install '.[test]' && pytest"])
def test_the_two_commands_stand_in_the_readme(line):
    assert line in README.read_text("utf-8").splitlines()


@pytest.mark.parametrize("line", ["fidsplat render scene.toml --no-such", "python benchmarks/no_such.py"])
def test_a_line_that_would_fail_is_noticed(line):
    with pytest.raises((SystemExit, AssertionError)):
        check_commands(line)


def test_the_files_of_the_examples_are_made_by_their_script(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["make_data.py", str(tmp_path)])
    runpy.run_path(str(EXAMPLES / "make_data.py"), run_name="__main__")
    assert (
        np.abs(read_image(tmp_path / "sky.png").astype(int) - read_image(EXAMPLES / "data/sky.png")).max()
        <= 1
    )
    again, kept = (fs.load_ply(folder / "globe.ply") for folder in (tmp_path, EXAMPLES / "data"))
    assert np.allclose(again.sh, kept.sh, atol=1e-6)
    assert np.allclose(again.means, kept.means, atol=1e-6)
