"""Flights: content of the images, resumption, contact sheets and videos; `fidsplat fly`."""

import json

import cv2
import numpy as np
import pytest
from full_disk import small_files

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import read_image
from fidsplat.images.video import write_video
from fidsplat.render.flight import Flight, FlightFolder
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix

SCENE = """
[camera]
width = 33
height = 24
fov_x_deg = 60.0
position = [0.0, 0.0, -1.0]
look_at = [0.0, 0.0, 0.0]

[[markers]]
spec = "aruco:4x4_50:7"
size = 0.4
"""
KEYFRAMES = """
[[camera.motion]]
time = 0.0
position = [0.0, 0.0, -1.0]
look_at = [0.0, 0.0, 0.0]

[[camera.motion]]
time = 1.0
position = [0.3, 0.0, -1.0]
look_at = [0.3, 0.0, 0.0]
"""
POSES = "0 0 0 -1 0 0 0 1\n1 0.3 0 -1 0 0 0 1\n"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIDSPLAT_DEVICE", "reference")
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "moving.toml").write_text(
        SCENE.replace("position =", "# ").replace("look_at", "#") + KEYFRAMES
    )
    (tmp_path / "poses.tum").write_text(POSES)
    return tmp_path


def fly(*words) -> int:
    return main(["fly", "scene.toml", "--trajectory", "poses.tum", "-o", "out", *words])


def small_flight(rate=2.0, **changes) -> Flight:
    path = fs.Trajectory([0.0, 1.0], [[0, 0, -1, 1, 0, 0, 0], [0.3, 0, -1, 1, 0, 0, 0]])
    scene = fs.Scene.load("scene.toml")
    return Flight(scene, path, path.sampled(rate).times, scene.capture.with_(**changes))


def test_each_image_has_its_pose(here):
    """As rendered alone from there, in every output."""
    assert fly("--rate", "2", "--outputs", "rgb,depth") == 0
    scene, renderer = fs.Scene.load("scene.toml"), fs.Renderer()
    for k, x in enumerate((0.0, 0.15, 0.3)):
        camera = fs.Camera.look_at(33, 24, np.radians(60), (x, 0, -1), (x, 0, 0))
        frame = renderer.render(scene, camera, outputs=("rgb", "depth"))
        rendered = read_image(f"out/rgb/{k:06d}.png") / 255
        assert np.abs(rendered - np.clip(frame["rgb"], 0, 1)).max() < 0.6 / 255
        np.testing.assert_allclose(np.load(f"out/depth/{k:06d}.npy"), frame["depth"], atol=1e-6)
    assert len(list((here / "out" / "depth").iterdir())) == 9
    poses = fs.load_trajectory("out/trajectory.tum")
    np.testing.assert_allclose(poses.poses[:, 0, 3], [0, 0.15, 0.3], atol=1e-12)
    printed = json.loads((here / "out" / "transforms.json").read_text())
    assert [frame["file_path"] for frame in printed["frames"]] == [f"rgb/{k:06d}.png" for k in range(3)]
    assert (here / "out" / "contact-sheet.png").exists()


def test_a_flights_images_are_read_from_where_its_camera_was(here, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    (here / "scene.toml").write_text(SCENE.replace("33", "160").replace("24", "120"))
    assert fly("--times", "0,0.2,0.5") == 0
    capsys.readouterr()
    for folder in ("out", "out/rgb"):
        assert main(["detect", folder, "--scene", "scene.toml", "--json"]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert [one["image"] for one in printed["pictures"]] == [f"out/rgb/{k:06d}.png" for k in range(3)]
        assert printed["means"]["found"] == 3
        assert printed["means"]["position_error_mm"] < 2  # by the scene's own camera it would be 70
    assert main(["detect", "out", "--scene", "scene.toml"]) == 0
    errors = capsys.readouterr().out.partition("Distances and errors")[2]
    assert all(f"{k:06d}" in errors for k in range(3))  # the image of each row
    copied = here / "alone.png"
    copied.write_bytes((here / "out/rgb/000002.png").read_bytes())
    assert main(["detect", "alone.png", "--scene", "scene.toml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["means"]["position_error_mm"] > 140


def test_a_flights_log_is_read_from_where_its_camera_was(here, capsys):
    logs = pytest.importorskip("fidsplat.logs", reason="pip install 'fidsplat[logs]'", exc_type=fs.InputError)
    (here / "scene.toml").write_text(SCENE.replace("33", "160").replace("24", "120"))
    assert fly("--times", "0,0.2,0.5", "--log", "run.mcap") == 0
    capsys.readouterr()
    assert main(["detect", "run.mcap", "--scene", "scene.toml", "--json"]) == 0
    means = json.loads(capsys.readouterr().out)["means"]
    assert means["found"] == 3
    assert means["position_error_mm"] < 2
    with logs.RobotLog("blind.mcap") as log:
        log.image(0.5, "camera", read_image("out/rgb/000002.png"))
        log.transform(0.25, "camera", np.eye(4))
    assert main(["detect", "blind.mcap"]) == 0
    assert main(["detect", "blind.mcap", "--scene", "scene.toml"]) == 2
    assert "in /tf at the time of /camera/image_raw 0.500 s" in capsys.readouterr().err


def test_a_flight_is_written_as_bop_and_a_compressed_log(here, capsys):
    logs = pytest.importorskip("fidsplat.logs", reason="pip install 'fidsplat[logs]'", exc_type=fs.InputError)
    words = ("--times", "0,0.5", "--outputs", "rgb,label", "--log", "run.mcap", "--compress", "png")
    assert fly(*words, "--bop", "set/train/000000") == 0
    scene = here / "set" / "train" / "000000"
    (pose,) = json.loads((scene / "scene_gt.json").read_text())["1"]
    matrix = np.reshape(json.loads((scene / "scene_camera.json").read_text())["1"]["cam_K"], (3, 3))
    half = 1000 * 0.4 / 2 * 8 / 6  # millimetres, with the quiet zone
    sheet = np.array([(x, y, 0.0) for x in (-half, half) for y in (-half, half)])
    turn, _ = cv2.Rodrigues(np.reshape(pose["cam_R_m2c"], (3, 3)))
    corners = cv2.projectPoints(sheet, turn, np.array(pose["cam_t_m2c"]), matrix, None)[0][:, 0] + 0.5
    y, x = np.nonzero(cv2.imread(str(scene / "mask_visib" / "000001_000000.png"), 0))
    np.testing.assert_allclose([x.min(), x.max() + 1, y.min(), y.max() + 1],
                               [*corners[[0, 2], 0], *corners[[0, 1], 1]], atol=1)  # fmt: skip
    first, second = logs.log_images("run.mcap")
    assert first.name.startswith("/camera/image_raw/compressed")
    np.testing.assert_array_equal(second.image, read_image("out/rgb/000001.png"))
    capsys.readouterr()
    assert fly("--times", "0", "-o", "alone", "--bop", "set/train/000001") == 0  # with the scene's outputs
    assert (here / "set" / "train" / "000001" / "scene_gt.json").is_file()
    for options, says in ((words, "must not have a scene yet"), (("--outputs", "depth"), "must have rgb")):
        assert fly(*options, "--bop", "set/train/000000") == 2
        assert says in capsys.readouterr().err


def test_poses_of_a_log_are_those_of_frames_in_the_world(here):
    logs = pytest.importorskip("fidsplat.logs", reason="pip install 'fidsplat[logs]'", exc_type=fs.InputError)
    pose = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
    with logs.RobotLog("run.mcap") as log:
        log.transform(0.5, "robot", pose)
        log.transform(0.5, "camera", pose, "robot")
    actual = logs.log_poses("run.mcap")
    assert list(actual) == [("robot", 500_000_000), ("camera", 500_000_000)]
    for moved, expected in zip(actual.values(), (pose, pose @ pose), strict=True):
        np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_a_video_does_not_say_where_its_camera_was(here, capsys):
    (here / "v.mp4").write_bytes(b"")
    assert main(["detect", "v.mp4", "--scene", "scene.toml"]) == 2
    assert "got the video v.mp4" in capsys.readouterr().err


def test_the_shutter_sees_the_camera_move(here):
    """Images of a flight are blurred along it, each about its own time."""
    flight = small_flight(shutter=fs.Shutter(exposure_time=0.2, sub_poses=2))
    capture = flight.captures[1]
    assert capture.has_sub_frames
    assert capture.shutter.time == 0.5
    assert capture.camera is not None
    for time in capture.shutter.times(0.5):
        seen = capture.motion.moved(capture.camera, time)
        np.testing.assert_allclose(seen.position, [0.3 * time, 0, -1], atol=1e-12)


def test_a_flight_goes_on_where_it_was(here, capsys):
    assert fly("--rate", "4") == 0
    first = {file.name: file.stat().st_mtime_ns for file in (here / "out" / "rgb").iterdir()}
    for name in ("000001.png", "000004.png"):
        (here / "out" / "rgb" / name).unlink()
    capsys.readouterr()
    assert fly("--rate", "4", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["frames"], printed["rendered"]) == (5, 2)
    again = {file.name: file.stat().st_mtime_ns for file in (here / "out" / "rgb").iterdir()}
    assert sorted(again) == sorted(first)
    assert sorted(name for name in first if first[name] != again[name]) == ["000001.png", "000004.png"]


def _bytes_of(log):
    files = sorted(log.iterdir()) if log.is_dir() else [log]
    return [(file.name, file.read_bytes()) for file in files]


@pytest.mark.parametrize("name", ["run.mcap", "bag"])
def test_a_flight_that_was_stopped_after_its_log_continues(here, capsys, monkeypatch, name):
    """The same command ends, with the same bytes; another flight's log stays."""
    pytest.importorskip("fidsplat.logs", reason="pip install 'fidsplat[logs]'", exc_type=fs.InputError)
    words = ["--times", "0,1", "--log", name, "--coco", "truth.json"]
    with monkeypatch.context() as patch:

        def stopped(folder, path):
            raise KeyboardInterrupt

        patch.setattr("fidsplat.commands.fly.write_truth", stopped)
        assert fly(*words) == 130
    first = _bytes_of(here / name)
    assert fly(*words) == 0
    assert (here / "truth.json").exists()
    assert _bytes_of(here / name) == first
    assert fly(*words, "--overwrite") == 0
    assert _bytes_of(here / name) == first
    capsys.readouterr()
    assert fly("--times", "0,0.5", "--log", name, "-o", "other") == 2
    assert f"{name} already exists" in capsys.readouterr().err
    assert not (here / "other").exists()
    assert _bytes_of(here / name) == first


def test_frames_are_not_mixed_with_those_of_another_flight(here, capsys):
    assert fly("--times", "0,1") == 0
    (here / "poses.tum").write_text(POSES.replace("0.3", "0.2"))
    assert fly("--times", "0,1") == 2
    assert "got another flight of 2 frames; give another folder" in capsys.readouterr().err
    before = (here / "out" / "rgb" / "000001.png").read_bytes()
    assert fly("--times", "0,1", "--overwrite") == 0
    assert (here / "out" / "rgb" / "000001.png").read_bytes() != before
    (here / "out" / "flight.json").unlink()
    assert fly("--times", "0,1") == 2
    assert "got frames without flight.json" in capsys.readouterr().err


def test_what_a_flight_is_of(here):
    """The key changes with everything that determines the images, and with nothing else."""
    key = small_flight().key("a")
    assert key == small_flight().key("a")
    others = [
        small_flight(3.0).key("a"),
        small_flight(quality=fs.Quality(samples=2)).key("a"),
        small_flight(background=(0.1, 0, 0)).key("a"),
        small_flight().key("b"),
    ]
    (here / "scene.toml").write_text(SCENE.replace("0.4", "0.41"))
    others.append(small_flight().key("a"))
    assert len({key, *others}) == 6


def test_a_flight_past_a_marker_that_moves_has_a_key(here):
    """Another one for another motion; the gallery has such keys too."""

    def key(far: float) -> str:
        flight = small_flight()
        path = fs.Trajectory([0.0, 1.0], np.stack([np.eye(4), rigid_matrix((far, 0, 0))]))
        scene = fs.Scene(markers=[PlacedMarker(fs.marker("aruco:4x4_50:7", size=0.4), motion=path)])
        capture = flight.capture.with_(motion=scene.motion)
        return Flight(scene, flight.trajectory, flight.times, capture).key("a")

    assert key(0.1) == key(0.1)
    assert key(0.1) != key(0.2)


def test_a_large_cloud_is_hashed_too(here):
    """Arrays of more than 64 KiB go to the hash where they lie."""
    flight = small_flight()
    means = np.zeros((30_000, 3), np.float32)

    def key(last: float) -> str:
        means[-1, 2] = last
        rest = np.ones((len(means), 4), np.float32)
        cloud = fs.SplatCloud(means, rest, rest[:, :2], rest[:, 0], colors=rest[:, :3])
        return Flight(fs.Scene([cloud]), flight.trajectory, flight.times, flight.capture).key("a")

    assert key(1.0) == key(1.0)
    assert key(1.0) != key(2.0)


def test_the_scenes_own_motion(here):
    assert main(["fly", "moving.toml", "-o", "own", "--rate", "2"]) == 0
    assert fly("--rate", "2") == 0
    for k in range(3):
        name = f"rgb/{k:06d}.png"
        assert (here / "own" / name).read_bytes() == (here / "out" / name).read_bytes()


def test_a_log_and_the_truth_next_to_the_images(here):
    logs = pytest.importorskip("fidsplat.logs", reason="pip install 'fidsplat[logs]'", exc_type=fs.InputError)
    words = ("--rate", "2", "--outputs", "rgb,label", "--log", "run.mcap", "--coco", "truth.json")
    assert fly(*words) == 0
    pictures = list(logs.log_images("run.mcap"))
    assert [one.name for one in pictures] == [f"/camera/image_raw {t:.3f} s" for t in (0, 0.5, 1)]
    np.testing.assert_array_equal(pictures[1].image, read_image("out/rgb/000001.png"))
    expected = json.loads((here / "truth.json").read_text())
    assert [image["file_name"] for image in expected["images"]] == [f"rgb/00000{k}.png" for k in range(3)]
    moved = [annotation["camera_from_marker"][0][3] for annotation in expected["annotations"]]
    np.testing.assert_allclose(moved, [0, -0.15, -0.3], atol=1e-9)
    own = np.load("out/label/000001.npy") == 1
    assert expected["annotations"][1]["area"] == own.sum() > 50


def test_a_log_named_as_the_output_has_its_images_next_to_it(here):
    pytest.importorskip("fidsplat.logs", reason="pip install 'fidsplat[logs]'", exc_type=fs.InputError)
    assert fly("--rate", "1", "-o", "run.mcap") == 0
    assert (here / "run.mcap").is_file()
    assert len(list((here / "run/rgb").iterdir())) == 2


def test_a_video_has_every_image(here):
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    pictures = [np.full((33, 47, 3), 60 + 20 * k, np.uint8) for k in range(4)]
    assert list(write_video("v.mp4", pictures, 10.0)) == [0, 1, 2, 3]
    video = cv2.VideoCapture("v.mp4")
    assert video.get(cv2.CAP_PROP_FPS) == 10
    for k in range(4):
        done, frame = video.read()
        assert done
        assert frame.shape == (34, 48, 3)  # H.264 wants even sides
        assert abs(float(frame.mean()) - (60 + 20 * k)) < 4
    assert not video.read()[0]
    with pytest.raises(fs.InputError, match="must have at least one frame"):
        list(write_video("none.mp4", [], 10.0))
    noise = [np.random.default_rng(k).integers(0, 256, (64, 64, 3), np.uint8) for k in range(4)]
    with small_files(2000), pytest.raises(fs.InputError, match="check that the disk has free space"):
        list(write_video("full.mp4", noise, 10.0))
    assert sorted(p.name for p in here.glob("*.mp4*")) == ["v.mp4"]
    assert list(here.glob(".*")) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--rate", "0"], "the rate must be a number of poses per second above 0, got 0.0"),
        (["--times", "0,noon"], "--times must be seconds separated by commas, got '0,noon'"),
        (["--times", "1,0"], "increasing"),
        (["--video", "a.avi"], "must have the suffix .mp4, got a.avi; use a.mp4"),
        (["--outputs", "deep"], "unknown output 'deep'"),
        (["--memory-budget", "lots"], "--memory-budget must be a number of bytes above 0, got 'lots'"),
        (["--trajectory", "none.tum"], "cannot read none.tum"),
        (
            ["--times", "0,1", "--rate", "-1"],
            "rate must be a number of poses per second above 0, got -1.0",
        ),
        (["--log", "poses.tum"], "poses.tum already exists"),
        (["--coco", "."], "got the folder ."),
        (["--compress", "png"], "--compress must be given with a log, got png; add --log FILE"),
        (["--compress", "jpeg", "--log", "a.mcap", "--outputs", "depth"], "--compress must have rgb among"),
    ],
)
def test_words_that_cannot_be_flown(here, capsys, words, message):
    assert fly(*words) == 2
    assert message in capsys.readouterr().err
    assert not (here / "out").exists()


def test_a_scene_without_motion_needs_a_trajectory(here, capsys):
    assert main(["fly", "scene.toml"]) == 2
    assert "scene.toml must have [[camera.motion]] to fly along" in capsys.readouterr().err


def test_sizes_in_bytes():
    from fidsplat.commands.declarations import parse_bytes

    sizes = {"1": 1, "2GiB": 2 * 2**30, "1.5 MB": 1_500_000, "3kb": 3000, "7 MiB": 7 * 2**20}
    assert {text: parse_bytes("--x", text) for text in sizes} == sizes
    for text in ("", "0", "-1", "2 GBit", "1e9", "GiB"):
        with pytest.raises(fs.InputError, match="must be a number of bytes above 0"):
            parse_bytes("--x", text)


def test_incomplete_images_are_rendered_again(here):
    """One file of three is missing: the output is."""
    flight = small_flight(outputs=("depth",))
    renderer = fs.Renderer()
    folder = FlightFolder("d", flight, renderer.device.title)
    assert list(folder.render(renderer)) == [0, 1, 2]
    assert folder.remaining() == []
    folder.file(1, "depth", ".npy").unlink()
    assert folder.remaining() == [1]
