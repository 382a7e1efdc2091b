"""The command line: exit statuses, one line for an error, --json alone on stdout, the commands of
the contract."""

import importlib
import io
import os
import subprocess
import sys
import time
from dataclasses import is_dataclass
from typing import Annotated, get_args, get_origin

import cv2
import numpy as np
import pytest
from command_line import fails, prints_json
from ideal_image import draw, photographed, pose, qr_bits, turned
from rich.console import Console
from tyro.constructors import MISSING_NONPROP, StructTypeInfo

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.commands import COMMANDS, declarations
from fidsplat.commands.output import delayed_progress
from fidsplat.images.files import read_image, write_png
from fidsplat.images.tag_dictionaries import dictionary_bits
from fidsplat.splats.statistics import describe
from fidsplat.util.errors import InputError

CAMERA = fs.Camera.pinhole(320, 240, 400, 400, 160, 120)


@pytest.fixture
def image_file(tmp_path):
    """A PNG with an AprilTag and a QR code side by side."""
    images = [
        draw(bits, 0.2, pose(turned(20), [0, 0, 0.6]), CAMERA, quiet)[0]
        for bits, quiet in ((dictionary_bits("apriltag", "36h11", 5), 1), (qr_bits("hello"), 4))
    ]
    return write_png(tmp_path / "codes.png", photographed(np.hstack(images)))


# --- words


@pytest.mark.parametrize("words", [["--help"], *([name, "--help"] for name in COMMANDS)])
def test_help_teaches_with_examples(words, capsys):
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "Examples:" in out
    assert err == ""
    if words == ["--help"]:
        listed = " ".join(out.replace("│", " ").split())
        for name, kind in COMMANDS.items():
            first = kind.__doc__.split(".")[0].split("\n")[0]
            assert f" {name} {' '.join(first.split()[:4])}" in listed, name


def commands_within(name, kind):
    """A command and the commands of its group, by their words."""
    if hasattr(kind, "run"):
        yield name, kind
    for part, inner in getattr(kind, "PARTS", {}).items():
        yield from commands_within(f"{name} {part}", inner)


def options_of(kind):
    """Names and help of the options of a command, also of the settings that it nests."""
    spec = declarations.describe_fields(StructTypeInfo.make(kind, MISSING_NONPROP, in_union_context=False))
    for field in spec.fields:
        base, *marks = get_args(field.type) if get_origin(field.type) is Annotated else (field.type,)
        if is_dataclass(base):
            yield from options_of(base)
        else:
            yield field.name, next(mark.help for mark in marks if hasattr(mark, "help_behavior_hint"))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_help_and_one_declaration(name):
    for words, kind in commands_within(name, COMMANDS[name]):
        names, texts = zip(*options_of(kind), strict=True)
        assert len(set(names)) == len(names), words
        missing = [option for option, text in zip(names, texts, strict=True) if not text]
        assert not missing, f"{words}: no help for {', '.join(missing)}"


def test_help_loads_nothing_heavy():
    code = (
        "import sys; sys.argv = ['fidsplat', '--help']; from fidsplat.cli import main; status = main();"
        "heavy = {'numpy', 'cv2', 'pyopencl', 'shapely', 'networkx', 'rich.table'} & set(sys.modules);"
        "sys.exit(f'loaded {heavy}' if heavy or status else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "try `fidsplat demo` first"),
        ([], "demo, devices, info, marker, render, view, fly, detect"),
        (["mraker"], "unknown command 'mraker' (did you mean 'marker'?); known: demo, devices"),
        (["store", "biuld", "a.ply"], "(did you mean 'build'?); known: build, place"),
        (["marker"], "SPEC"),
        (["marker", "qr:a", "--sise", "1"], "perhaps --size M; see fidsplat marker --help"),
        (["marker", "qr:a", "--size", "big"], "--size must be a number, got 'big'; see fidsplat marker"),
        (["marker", "qr:a", "--size", "it's"], '--size must be a number, got "it\'s"; see fidsplat marker'),
        (["view", "--port", "abc"], "--port must be a whole number, got 'abc'; see fidsplat view --help"),
        (["check", "--fuzz", "1e5"], "--fuzz must be a whole number, got '1e5'; see"),
        (["marker", "qr:a", "qr:b"], "Unrecognized options: qr:b"),
        (["render"], "SCENE.toml"),
        (["detect", "--json"], "IMAGE"),
    ],
)
def test_invalid_arguments(words, says, capsys):
    status, line = fails(capsys, *words)
    assert status == 2
    assert says in line


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["marker", "apriltag:36h12:5"], "36h11"),
        (["marker", "apriltag:36h11:587"], "0 to 586"),
        (["marker", "aruco:4x4_50:50"], "0 to 49"),
        (["marker", "aruco:4x4_50:-1"], "whole number"),
        (["marker", "barcode:5"], "barcode"),
        (["marker", "qr-v2-L:" + "x" * 200], "2"),
        (["marker", "image:missing.png"], "missing.png"),
        (["marker", "apriltag:36h11:5", "--size", "0"], "size"),
        (["marker", "apriltag:36h11:5", "--size", "-1"], "size"),
        (["marker", "apriltag:36h11:5", "--mixture", "bricks"], "fitted"),
        (["marker", "apriltag:36h11:5", "-o", "/proc/nowhere/tag.ply"], "/proc/nowhere"),
        (["detect", "missing.png"], "missing.png"),
        (["render", "missing.toml"], "missing.toml"),
        (["render", "missing.ply"], "missing.ply"),
        (["render", "scene.yaml"], "scene.yaml"),
        (["render", "."], "the source must be a scene file (.toml) or a splat file, got the folder ."),
        (["render", "missing.ply", "--outputs", "rgb,dpth"], "depth"),
        (["render", "missing.ply", "--quality", "best"], "standard"),
        (["render", "missing.ply", "-o", "picture.jpg"], "picture.png"),
        (["render", "missing.ply", "-o", "/proc/nowhere/frames"], "/proc/nowhere"),
        (["demo", "--out", "/proc/nowhere"], "/proc/nowhere"),
    ],
)
def test_unusable_input(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, line = fails(capsys, *words)
    assert status == 2
    assert says in line
    assert list(tmp_path.iterdir()) == []


def test_detect_refuses_unknown_families_and_damaged_images(capsys, image_file, tmp_path):
    status, line = fails(capsys, "detect", image_file, "--family", "36h12")
    assert status == 2
    assert "36h11" in line
    broken = tmp_path / "broken.png"
    broken.write_bytes(image_file.read_bytes()[:400])
    assert fails(capsys, "detect", broken)[0] == 2


def test_a_terminal_without_unicode_gets_help_and_errors(tmp_path):
    plain = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}

    def run(*words):
        command = [sys.executable, "-m", "fidsplat", *words]
        return subprocess.run(command, capture_output=True, text=True, env=plain, cwd=tmp_path)

    assert run("--help").returncode == 0
    assert run("devices").returncode == 0
    wrong = run("marker", "qr:a", "--sise", "1")
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)
    assert "perhaps --size M" in wrong.stderr


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr() == (f"fidsplat {fs.__version__}\n", "")


# --- statuses


def test_a_failed_run_is_status_1_and_an_unexpected_error_is_named(capsys, monkeypatch):
    def broken(self):
        raise fs.DeviceError("the device\ngave up")

    monkeypatch.setattr(COMMANDS["devices"], "run", broken)
    assert fails(capsys, "devices") == (1, "fidsplat: the device gave up\n")

    def faulty(self):
        raise KeyError("surprise")

    monkeypatch.setattr(COMMANDS["devices"], "run", faulty)
    status, line = fails(capsys, "devices")
    assert status == 1
    assert "--debug" in line

    class HalfMade:
        def __del__(self):
            raise AttributeError("what its constructor had not come to")

    def interrupted(self):
        half = HalfMade()  # noqa: F841
        raise KeyboardInterrupt

    monkeypatch.setattr(COMMANDS["devices"], "run", interrupted)
    heard = []
    monkeypatch.setattr(sys, "unraisablehook", heard.append)
    assert fails(capsys, "devices") == (130, "fidsplat: interrupted\n")
    assert heard == []


@pytest.mark.parametrize(
    "words", [["--debug", "detect", "missing.png"], ["detect", "missing.png", "--debug"]]
)
def test_debug_anywhere_shows_the_traceback(words, capsys):
    assert main(words) == 2
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert err.splitlines()[-1].startswith("fidsplat: ")


def test_a_closed_output_pipe_prints_no_traceback(image_file):
    # the reader is gone before the first word is written
    words = ["detect", str(image_file)]
    code = f"import sys; sys.stdin.read(); from fidsplat.cli import main; sys.exit(main({words}))"
    pipe = subprocess.PIPE
    done = subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, stderr=pipe, text=True)
    assert done.stdin is not None
    assert done.stdout is not None
    assert done.stderr is not None
    done.stdout.close()
    done.stdin.close()
    err = done.stderr.read()
    done.stderr.close()
    assert done.wait() == 1
    assert "Traceback" not in err
    assert "BrokenPipe" not in err


def test_warnings_are_one_line_each_and_leave_no_trace(capsys, monkeypatch):
    import warnings

    def warn(self):
        warnings.warn("two\nlines", stacklevel=1)
        return 0

    before = warnings.showwarning
    monkeypatch.setattr(COMMANDS["devices"], "run", warn)
    assert main(["devices"]) == 0
    assert capsys.readouterr().err == "fidsplat: warning: two lines\n"
    assert warnings.showwarning is before


# --- devices, info, detect


def test_devices(capsys):
    listed_devices = prints_json(capsys, "devices")["devices"]
    assert "reference" in {device["name"] for device in listed_devices}
    assert {"platform", "version", "memory_bytes", "float64", "usable", "reason"} <= set(listed_devices[0])
    assert main(["devices"]) == 0
    assert "reference" in capsys.readouterr().out


def test_progress_is_shown_for_long_work(monkeypatch):
    for after in (60.0, 0.0):
        shown = io.StringIO()
        terminal = Console(file=shown, force_terminal=True)
        monkeypatch.setattr("fidsplat.commands.output.console", lambda as_json, terminal=terminal: terminal)
        with delayed_progress(after) as progress:
            progress("squares", 0.5)
            deadline = time.monotonic() + 30
            while not after and "squares" not in shown.getvalue() and time.monotonic() < deadline:
                time.sleep(0.01)
        assert ("squares" in shown.getvalue()) == (after == 0)


def test_info(capsys, tmp_path):
    """A ground of level splats and a post on it, y down, with a stray far away."""
    generator = np.random.default_rng(0)
    ground = generator.uniform(-2, 2, (2000, 3)) * [1, 0, 1] + [0, 1, 0]
    post = generator.uniform(-1, 1, (300, 3)) * [0.1, 1, 0.1]
    means = np.concatenate([ground, post, [[0, 0, 500]]])
    level = np.sqrt(0.5) * np.array([1, 1, 0, 0])
    quats = np.concatenate([np.tile(level, (2000, 1)), np.tile([1, 0, 0, 0], (301, 1))])
    cloud = fs.SplatCloud(
        means, quats, np.full((2301, 2), 0.05), np.full(2301, 0.9), colors=np.ones((2301, 3))
    )
    fs.save_ply(cloud, tmp_path / "yard.ply")
    facts = prints_json(capsys, "info", tmp_path / "yard.ply")
    assert (facts["splats"], facts["up"]) == (2301, "-y")
    assert facts["bounds"][1][2] > 499
    assert facts["middle_bounds"][1][2] < 2.1
    assert facts["height"] == pytest.approx(2, abs=0.1)
    assert facts["scales"] == pytest.approx([0.05] * 3, rel=1e-5)
    assert 0.2 <= facts["marker_size"] <= 0.5
    assert main(["info", str(tmp_path / "yard.ply")]) == 0
    assert "-y? (87 % of the area is level)" in capsys.readouterr().out
    statue = means[2000:2300] * [1, 5, 1]
    statue = fs.SplatCloud(
        statue, generator.normal(size=(300, 4)), np.ones((300, 2)), np.ones(300), colors=statue
    )
    fs.save_ply(statue, tmp_path / "statue.ply")
    assert prints_json(capsys, "info", tmp_path / "statue.ply")["up_because"] == "the longest side"
    assert "missing.ply" in fails(capsys, "info", tmp_path / "missing.ply")[1]
    fs.save_ply(fs.SplatCloud.empty(), tmp_path / "empty.ply")
    assert prints_json(capsys, "info", tmp_path / "empty.ply")["splats"] == 0
    assert main(["info", str(tmp_path / "empty.ply")]) == 0


def test_detect(capsys, image_file):
    result = prints_json(capsys, "detect", image_file)
    assert [code["name"] for code in result["detections"]] == ["apriltag:36h11:5", "qr:hello"]
    assert np.array(result["detections"][0]["corners"]).shape == (4, 2)
    assert main(["detect", str(image_file)]) == 0
    assert "apriltag:36h11:5" in capsys.readouterr().out
    assert (
        prints_json(capsys, "detect", image_file, "--family", "4x4_50", "--family", "25h9")["detections"][0][
            "id"
        ]
        is None
    )


def test_detect_in_folders_and_videos(capsys, image_file, tmp_path):
    folder = tmp_path / "stills"
    folder.mkdir()
    for name in ("b.png", "a.png"):
        write_png(folder / name, read_image(image_file))
    (folder / "notes.txt").write_text("not an image")
    result = prints_json(capsys, "detect", folder)
    assert [one["image"] for one in result["pictures"]] == [str(folder / "a.png"), str(folder / "b.png")]
    assert main(["detect", str(folder), str(image_file)]) == 0
    out = capsys.readouterr().out
    assert "3 images" in out
    assert out.count("apriltag:36h11:5") == 3

    image = read_image(image_file)
    film = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, image.shape[1::-1])
    assert writer.isOpened()
    for _ in range(2):
        writer.write(image[:, :, ::-1])
    writer.release()
    result = prints_json(capsys, "detect", film)
    assert [one["image"] for one in result["pictures"]] == [f"{film}:0", f"{film}:1"]
    assert result["pictures"][1]["detections"][0]["name"] == "apriltag:36h11:5"

    (tmp_path / "empty").mkdir()
    assert "must contain an image file" in fails(capsys, "detect", tmp_path / "empty")[1]
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    assert "as a video" in fails(capsys, "detect", tmp_path / "broken.mp4")[1]


def test_detect_where_nothing_is(capsys, tmp_path):
    empty = write_png(tmp_path / "empty.png", np.zeros((90, 120)))
    assert prints_json(capsys, "detect", empty)["detections"] == []
    assert main(["detect", str(empty)]) == 0
    assert "no code found" in capsys.readouterr().out


def test_a_marker_position_shows_no_rounding_errors():
    tag = fs.marker("apriltag:36h11:5", size=0.16).gaussians  # its mean position is 1e-17 m from 0
    assert describe(tag)["marker_position"][:2].tolist() == [0, 0]


def test_figures_of_a_cloud_move_with_its_origin():
    """Lengths stay, places move."""
    from fidsplat.scenes.random_clouds import random_splats

    cloud, away = random_splats(500, 4), np.array([4e5, -3e5, 100.0])
    arrays = {name: getattr(cloud, name) for name in ("means", "quats", "scales", "opacities", "colors")}
    near, far = describe(cloud), describe(fs.SplatCloud(**arrays, origin=cloud.origin + away))
    assert near.keys() == far.keys()
    for name, value in near.items():
        moved = np.asarray(far[name])
        if name in ("bounds", "middle_bounds", "marker_position"):
            np.testing.assert_allclose(moved, np.asarray(value) + away, atol=1e-6, err_msg=name)
        elif isinstance(value, float):
            assert far[name] == pytest.approx(value, rel=1e-6), name


def test_experiments_need_mujoco_only_to_drive(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "fidsplat.worlds.robot", raising=False)
    robot = importlib.import_module("fidsplat.worlds.robot")  # as all experiments do
    with pytest.raises(InputError, match=r"MuJoCo must be installed.*fidsplat\[sim\]"):
        robot.drive("", np.array([(0.0, 0.0), (1.0, 0.0)]))
