"""Code blocks of README and docs/ work: Python runs, scene files load, commands run (or parse, if slow), and
links lead to files."""

import re
import runpy
import shlex
import shutil
import sys
from glob import glob
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from sybil import Sybil
from sybil.example import Example
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser

import fidsplat as fs
from fidsplat.cli import _parse, main
from fidsplat.images.files import read_image

TREE = Path(__file__).resolve().parents[2]
README = TREE / "README.md"
EXAMPLES = TREE / "examples"
PAGES = [README, TREE / "CONTRIBUTING.md", *sorted((TREE / "docs").glob("*.md"))]
DEVLOG = sorted((TREE / "devlog").glob("*.md"))
GIVEN = {
    "large-scenes.md",
    "markers.md",
    "README.md",
    "rendering.md",
    "scene-files.md",
}  # their blocks read a room.ply, which readers have


def load_scene(example: Example) -> None:
    """Save and load a scene file, named by its first comment, else scene.toml."""
    name = re.match(r"# (\S+\.toml)", example.parsed)
    path = Path(name[1] if name else "scene.toml")
    path.write_text(example.parsed, "utf-8")
    fs.Scene.load(path)


PARSED_ONLY = {
    "serve": "ends by Ctrl-C; tests/unit/test_serve.py",
    "capture": "needs photographs; tests/unit/test_photographs_command.py",
    "bench": "times the machine",
    "check": "minutes; tests/selftest",
    "demo": "tests/unit/test_demo.py runs it",
    "experiment": "minutes; tests/experiments",
    "plan-tags": "needs walls; tests/unit/test_tag_placement.py",
    "tradeoff": "minutes; tests/experiments",
    "train": "minutes; tests/unit/test_train_command.py",
    "localise": "needs photographs; tests/unit/test_localisation.py",
    "fetch": "needs the network; tests/unit/test_captured_scenes.py",
    "view": "ends when it is stopped; tests/unit/test_viewer_*.py",
}
"""commands that are parsed but not run, with the reason"""
PARSED_WORDS = {
    "--device": "a machine's own",
    "--max-ms": "times the machine",
    "--plants-from": "made by an experiment",
    "--ray": "a cluster",
    "scene.html": "needs npm; tests/unit/test_scene_page.py",
    "bench/scene.toml": "made from photographs",
    "city/city.toml": "a hundred frames of 1280 x 720; tests/unit/test_flights.py",
}
SMALLER = {
    "store demo": ["--splats", "20000", "--houses", "1", "--views", "0", "--markers", "2"],
    "store measure": ["--views", "2"],
}
"""options that make a command fast"""
EXTRAS = {
    "experiments": ("pandas", "matplotlib", "pupil_apriltags", "locus", "flip_evaluator", "jinja2"),
    "logs": ("mcap", "rosbags"),
    "live": ("foxglove", "cyclonedds"),
    "mesh": ("fast_simplification",),
    "sim": ("mujoco", "gymnasium", "small_gicp"),
    "usd": ("pxr",),
    "video": ("imageio_ffmpeg",),
    "viewer": ("viser",),
}
"""modules of extras; they are hidden from lines whose page does not mention the extra"""


SLOW = {"check", "demo", "experiment", "bench", "tradeoff", "train"}
SLOW |= {"--max-ms", "city/city.toml"}
"""of both, what ends and runs on every machine: `pytest -m exhaustive tests/unit/test_docs.py` runs it"""


def check_commands(text: str, run=lambda words, line: None) -> None:
    """Parse every `fidsplat` command and pass it to `run`; check that Python scripts exist."""
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.shlex(line, posix=True, punctuation_chars=";&|>")
        words.whitespace_split = True
        command: list[str] = []
        for word in [*words, ";"]:
            if set(word) <= set(";&|>"):
                check_command(command)
                if command[:1] == ["fidsplat"]:
                    run(command[1:], line)
                command = []
            elif word != "do" and not re.fullmatch(r"[A-Z_]+=\S*", word):
                command.append(word)


def check_command(words: list[str]) -> None:
    if words[:1] == ["fidsplat"]:
        _parse(words[1:])
    elif words[:1] == ["python"] and words[1].endswith(".py"):
        assert (TREE / words[1]).exists(), f"{words[1]} does not exist"


def run_command(words: list[str], line: str, page: str) -> None:
    """Run a command in the folder of the test, without extras that are not mentioned."""
    verb = " ".join(words[:2]) if words[0] == "store" else words[0]
    if verb in PARSED_ONLY or set(PARSED_WORDS) & set(words):
        return
    with pytest.MonkeyPatch.context() as hidden:
        for extra, modules in EXTRAS.items():
            if f"(extra: {extra})" in line or re.search(rf"pip install '\S*\[[\w,]*\b{extra}\b", page):
                if any(find_spec(module) is None for module in modules):
                    return
            else:
                for module in modules:
                    hidden.setitem(sys.modules, module, None)
        for word in words:
            if word in READERS_FILES and not glob(word):
                READERS_FILES[word]()
        arguments = [name for word in words for name in (sorted(glob(word)) if "*" in word else [word])]
        assert main([*arguments, *SMALLER.get(verb, [])]) == 0, line


def save_city(name: str):
    """Save a row of splats in front of the camera, as a PLY file or a store with levels of detail."""
    n = 300
    places = np.stack([np.linspace(-1, 1, n), np.zeros(n), np.full(n, 3.0)], 1)
    row = fs.SplatCloud(places, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 2), 0.1), np.full(n, 0.9),
                        colors=np.full((n, 3), 0.5))  # fmt: skip
    if name.endswith(".ply"):
        fs.save_ply(row, name)
    else:
        save_city("house.ply")
        assert main(["store", "build", "house.ply", "-o", name]) == 0


def copy_examples() -> None:
    """Copy two scenes of `examples/`; tests/unit/test_imaging.py renders all of them."""
    Path("examples").mkdir()
    for name in ("boxes", "worn-tag"):
        shutil.copy(EXAMPLES / f"{name}.toml", "examples")


SCENE = """[camera]
width = 120
height = 90
fov_x_deg = 60.0
position = [0.0, 0.0, -0.5]
look_at = [0.0, 0.0, 0.0]
[[markers]]
spec = "apriltag:36h11:5"
size = 0.2
[render]
background = [0.5, 0.5, 0.5]
"""
POSES = "0 0 0 -0.5 0 0 0 1\n0.1 0.01 0 -0.5 0 0 0 1\n"
READERS_FILES = {
    "scene.toml": lambda: Path("scene.toml").write_text(SCENE),
    "flight.tum": lambda: Path("flight.tum").write_text(POSES),
    "yard.ply": lambda: save_city("yard.ply"),
    "block-*.ply": lambda: save_city("block-1.ply"),
    "house.fss": lambda: save_city("house.fss"),
    "examples/*.toml": copy_examples,
}
"""files of readers, created before the first command that names them"""


def run_commands(example: Example) -> None:
    page = example.document.text
    check_commands(example.parsed, lambda words, line: run_command(words, line, page))


BLOCKS = Sybil(
    [
        PythonCodeBlockParser(),
        SkipParser(),
        CodeBlockParser("toml", load_scene),
        CodeBlockParser("bash", run_commands),
    ]
)


def create_room() -> None:
    """Create a splat file room.ply of a reader."""
    far = np.array([[0.0, 0.0, 3.0]])
    room = fs.SplatCloud(far, [[1.0, 0, 0, 0]], [[1.0, 1.0]], [0.9], colors=[[0.7, 0.6, 0.5]])
    fs.save_ply(room, "room.ply")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_blocks_work_as_printed(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page.name in GIVEN:
        create_room()
    for example in BLOCKS.parse(page).examples():
        example.evaluate()


@pytest.mark.exhaustive
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_slow_commands_work_as_printed(page, tmp_path, monkeypatch):
    """The code blocks again, with the commands that the test above only parses (up to an hour for all pages).
    Those that need a GPU, a cluster, or a download are left to their own tests."""
    for parsed in (PARSED_ONLY, PARSED_WORDS):
        for name in SLOW & set(parsed):
            monkeypatch.delitem(parsed, name)
    monkeypatch.setitem(PARSED_WORDS, "blender", "a download of 1 GB")
    monkeypatch.setitem(PARSED_WORDS, "plants", "needs Blender")
    monkeypatch.setitem(PARSED_WORDS, "bench/splats.ply", "needs a folder of photographs")
    monkeypatch.setitem(PARSED_WORDS, "shards", "made by eight processes")
    test_code_blocks_work_as_printed(page, tmp_path, monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_has_a_language(page):
    """Only languages that the test above handles, or text."""
    known = {"python", "toml", "bash", "text"}
    fences = re.findall(r"^ *```(.*)$", page.read_text("utf-8"), re.MULTILINE)
    assert set(fences[::2]) <= known
    assert set(fences[1::2]) <= {""}


@pytest.mark.parametrize("page", [*PAGES, *DEVLOG], ids=lambda page: page.name)
def test_every_link_leads_to_a_file_and_heading(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), f"{page.name} points at {target}"
        assert not anchor or anchor in anchors(file), f"{page.name} points at {target}, which is no heading"


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and mkdocs make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.*)", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower().strip()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("line", ["pip install . && fidsplat demo", "pip install '.[test]' && pytest"])
def test_the_readme_has_the_install_commands(line):
    assert line in README.read_text("utf-8").splitlines()


@pytest.mark.parametrize("line", ["fidsplat render scene.toml --no-such", "python benchmarks/no_such.py"])
def test_invalid_lines_are_detected(line):
    with pytest.raises((fs.InputError, AssertionError)):
        check_commands(line)


def test_the_files_of_the_examples_are_made_by_their_script(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["make_data.py", str(tmp_path)])
    runpy.run_path(str(EXAMPLES / "make_data.py"), run_name="__main__")
    assert (
        np.abs(read_image(tmp_path / "sky.png").astype(int) - read_image(EXAMPLES / "data/sky.png")).max()
        <= 1
    )
    for name in ("globe", "corner"):
        written, stored = (fs.load_ply(folder / f"{name}.ply") for folder in (tmp_path, EXAMPLES / "data"))
        assert np.allclose(written.sh, stored.sh, atol=1e-6)
        assert np.allclose(written.means, stored.means, atol=1e-6)
