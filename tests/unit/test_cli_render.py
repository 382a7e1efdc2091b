"""`fidsplat render` and its files, and `fidsplat detect --scene` on these files."""

import json

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import read_image, to_uint8
from fidsplat.scenes.sources import framing_camera

SCENE = """
[camera]
width = 160
height = 120
fov_x_deg = 60.0
position = [0.0, 0.0, -0.5]
look_at = [0.0, 0.0, 0.0]

[[markers]]
spec = "apriltag:36h11:5"
size = 0.25
position = [0.02, 0.0, 0.1]

[render]
background = [0.5, 0.5, 0.5]
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    return "scene.toml"


def tag_cloud() -> fs.SplatCloud:
    return fs.marker("apriltag:36h11:5", size=0.4).gaussians


def printed_json(capsys) -> dict:
    return json.loads(capsys.readouterr().out)


def names(folder) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_budget_is_measured_and_reported(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("fidsplat.accuracy.quality_within.cache_folder", lambda: tmp_path / "cache")
    words = ["render", scene, "--max-error", "1e-3", "--max-ms", "60000"]
    assert main([*words, "--json"]) == 0
    chosen = printed_json(capsys)["chosen"]
    assert 0 < chosen["error"] <= 1e-3
    assert 0 < chosen["ms"] <= chosen["ms_p90"] <= 60000
    assert chosen["source"] == "measured"
    assert 0 < chosen["certified"] <= 1e-3
    assert chosen["remark"] == ""
    assert fs.Quality().with_(**chosen["settings"])
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "chosen: alpha_cutoff" in printed
    assert "measured error" in printed
    assert main(["render", scene, "--json"]) == 0
    assert printed_json(capsys)["chosen"] is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--max-error", "nan"],
            "--max-error must be a finite number, got nan; try --max-error 1e-3",
        ),
        (["--max-error", "1e-12"], "--max-error must be at least"),
        (["--max-ms", "1e-9"], "--max-ms must be at least"),
    ],
)
def test_impossible_bounds(scene, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.setattr("fidsplat.accuracy.quality_within.cache_folder", lambda: tmp_path / "cache")
    assert main(["render", scene, *words]) == 2
    assert message in capsys.readouterr().err


def test_a_scene_is_rendered_and_read_back(scene, tmp_path, capsys):
    assert main(["render", scene, "--json"]) == 0
    facts = printed_json(capsys)
    assert facts["files"] == ["scene.png"]
    assert (facts["width"], facts["height"], facts["outputs"]) == (160, 120, ["rgb"])
    assert facts["stats"]["splats"] > 0
    assert facts["timings_ms"]
    assert read_image("scene.png").shape == (120, 160, 3)

    assert main(["detect", "scene.png", "--scene", scene, "--json"]) == 0
    facts = printed_json(capsys)
    (marker,) = facts["markers"]
    assert marker["found"]
    assert marker["position_error_mm"] < 6
    assert marker["angle_error_deg"] < 5
    assert marker["corner_error_px"] < 0.5
    assert facts["not_in_scene"] == []
    assert main(["detect", "scene.png", "--scene", scene]) == 0
    out = capsys.readouterr().out
    assert "Distances and errors, scene.toml" in out
    assert "position [mm]" in out


def test_what_moves_is_compared_with_its_pose_at_the_shutters_time(scene, tmp_path, capsys):
    """The camera has passed 0.06 m by then, the tag 0.03 m: far more than the error."""
    keyframes = """
[[camera.motion]]
time = 0.0
position = [0.0, 0.0, -0.5]
look_at = [0.0, 0.0, 0.0]

[[camera.motion]]
time = 1.0
position = [0.12, 0.0, -0.5]
look_at = [0.12, 0.0, 0.0]
"""
    tag = "motion = [{time = 0.0, position = [0.02, 0.0, 0.1]}, {time = 1.0, position = [0.02, 0.06, 0.1]}]"
    text = SCENE.replace(
        "position = [0.0, 0.0, -0.5]\nlook_at = [0.0, 0.0, 0.0]\n", "[camera.shutter]\ntime = 0.5"
    )
    text = text.replace("position = [0.02, 0.0, 0.1]\n", f"{tag}\n")
    (tmp_path / scene).write_text(text + keyframes)
    assert main(["render", scene]) == 0
    capsys.readouterr()
    assert main(["detect", "scene.png", "--scene", scene, "--json"]) == 0
    (marker,) = printed_json(capsys)["markers"]
    assert marker["found"]
    assert marker["position_error_mm"] < 6
    assert marker["corner_error_px"] < 0.5


def test_every_output_is_a_file(scene, tmp_path, capsys):
    words = "rgb,alpha,depth,depth_median,distance_first,normal,normal_world,label,splat_id,blended"
    assert main(["render", scene, "-o", "frames", "--outputs", words, "--json"]) == 0
    assert sorted(printed_json(capsys)["files"]) == sorted(
        f"frames/{name}" for name in names(tmp_path / "frames")
    )
    assert names(tmp_path / "frames") == {
        *("rgb.png", "alpha.png", "normal.png", "label.png", "label.npy"),
        *("depth.png", "depth.npy", "depth-turbo.png"),
        *("depth_median.png", "depth_median.npy", "depth_median-turbo.png"),
        *("distance_first.png", "distance_first.npy", "distance_first-turbo.png", "normal_world.png"),
        *("splat_id.png", "splat_id.npy", "blended.png", "blended.npy"),
    }
    depth = np.load("frames/depth.npy")
    assert depth.shape == (120, 160)
    assert depth[60, 80] == pytest.approx(0.6, abs=0.01)
    millimetres = cv2.imread("frames/depth.png", cv2.IMREAD_UNCHANGED)
    assert millimetres is not None
    assert millimetres.dtype == np.uint16
    assert millimetres[60, 80] == round(float(depth[60, 80]) * 1000)
    assert set(np.unique(np.load("frames/label.npy"))) == {-1, 1}
    assert read_image("frames/normal.png")[60, 80].tolist() == [128, 128, 0]


def test_a_name_with_png_is_the_colour_image_and_other_planes_are_next_to_it(scene, tmp_path):
    assert main(["render", scene, "-o", "new/view.png", "--outputs", "rgb,label"]) == 0
    assert names(tmp_path / "new") == {"view.png", "view-label.png", "view-label.npy"}


def test_the_outputs_and_the_device_of_the_scene_are_the_default(scene, tmp_path, capsys):
    small = SCENE.replace("width = 160", "width = 16").replace("height = 120", "height = 12")
    (tmp_path / "scene.toml").write_text(small + 'outputs = ["depth"]\ndevice = "reference"\n')
    assert main(["render", scene, "--json"]) == 0
    assert printed_json(capsys)["device"] == "reference"
    assert {"scene-depth.npy", "scene-depth.png", "scene-depth-turbo.png"} <= names(tmp_path)
    assert "scene.png" not in names(tmp_path)


def test_a_bare_splat_file_is_framed(scene, tmp_path, capsys):
    fs.save_ply(tag_cloud(), "tag.ply")
    assert main(["render", "tag.ply", "--json"]) == 0
    facts = printed_json(capsys)
    assert facts["files"] == ["tag.png"]
    image = read_image("tag.png")
    assert image.shape == (720, 1280, 3)
    rows = np.flatnonzero(image.max((1, 2)) > 128)
    assert rows[0] > 5
    assert rows[-1] < 714
    assert rows[-1] - rows[0] > 400, "it fills the image"
    assert main(["detect", "tag.png", "--json"]) == 0
    assert [code["name"] for code in printed_json(capsys)["detections"]] == ["apriltag:36h11:5"]


def test_nothing_to_render_is_the_background(scene, tmp_path):
    fs.save_ply(fs.SplatCloud.empty(), "empty.ply")
    text = (
        SCENE.split("[[markers]]")[0]
        + '[[splats]]\nfile = "empty.ply"\n[render]\nbackground = [0.2, 0.4, 0.6]\n'
    )
    (tmp_path / "scene.toml").write_text(text)
    assert main(["render", scene]) == 0
    assert np.unique(read_image("scene.png").reshape(-1, 3), axis=0).tolist() == [[51, 102, 153]]
    assert main(["render", "empty.ply"]) == 0
    assert read_image("empty.png").max() == 0


@pytest.mark.parametrize(
    ("words", "status", "says"),
    [
        (["--device", "opencl:nosuchthing"], 2, "nosuchthing"),
        (["--device", "vulkan"], 2, "vulkan"),
        (["--quality", "standrad"], 2, "standard"),
        (["--quality", "fast,alpha_cutof=1e-3"], 2, "did you mean 'alpha_cutoff'"),
        (["--outputs", ""], 2, "output"),
    ],
)
def test_invalid_frames(scene, words, status, says, capsys):
    assert main(["render", scene, *words]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert says in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("fov_x_deg", "fov_x_degs"), "fov_x_deg"),
        (("[[markers]]", '[[splats]]\nfile = "gone.ply"\n[[markers]]'), "gone.ply"),
        (("36h11:5", "36h11:5000"), "586"),
        (("size = 0.25", "size = 0.0"), "size"),
        (("[camera]", "[camra]"), "camera"),
        (("background", 'outputs = ["dpth"]\nbackground'), "scene.toml: render.outputs: unknown output"),
        (("background", 'device = "vulkan"\nbackground'), "scene.toml: render.device: unknown device"),
    ],
)
def test_scene_files_that_are_wrong(scene, tmp_path, change, says, capsys):
    (tmp_path / "scene.toml").write_text(SCENE.replace(*change))
    assert main(["render", scene]) == 2
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1


def test_a_device_of_the_environment_is_not_the_scenes(scene, monkeypatch, capsys):
    monkeypatch.setenv("FIDSPLAT_DEVICE", "vulkan")
    assert main(["render", scene]) == 2
    assert capsys.readouterr().err.startswith("fidsplat: unknown device 'vulkan'")


def test_a_scene_needs_a_camera(scene, tmp_path, capsys):
    (tmp_path / "scene.toml").write_text("[render]\n")
    assert main(["render", scene]) == 2
    assert "[camera]" in capsys.readouterr().err


def test_detect_requires_the_image_of_that_scene(scene, tmp_path, capsys):
    from fidsplat.images.files import write_png

    write_png("other.png", np.zeros((50, 60)))
    assert main(["detect", "other.png", "--scene", scene]) == 2
    assert "160 x 120" in capsys.readouterr().err


def test_the_frame_leaves_strays_out_only_when_there_are_many():
    random = np.random.default_rng(0)
    means = random.uniform(-1, 1, (20_000, 3))
    means[0] = (500, 0, 0)
    many = fs.SplatCloud(
        means,
        np.tile([1.0, 0, 0, 0], (20_000, 1)),
        np.full((20_000, 2), 0.01),
        np.ones(20_000),
        colors=means * 0,
    )
    assert np.linalg.norm(framing_camera(many).position) < 5
    few = fs.SplatCloud(means[:5], many.quats[:5], many.scales[:5], np.ones(5), colors=np.zeros((5, 3)))
    inside = framing_camera(few).project(means[:5])
    assert ((inside > 0) & (inside < (1280, 720))).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_frame_holds_a_cloud_that_is_long_along_one_axis(axis):
    half = np.full(3, 0.2)
    half[axis] = 3.0
    ends = np.stack(np.meshgrid(*([-1, 1],) * 3), -1).reshape(-1, 3) * half + (5.0, -2.0, 7.0)
    turns, sizes = np.tile([1.0, 0, 0, 0], (8, 1)), np.full((8, 2), 1e-3)
    cloud = fs.SplatCloud(ends, turns, sizes, np.ones(8), colors=np.ones((8, 3)))
    camera = framing_camera(cloud)
    inside = camera.project(ends)
    assert ((inside > 0) & (inside < (camera.width, camera.height))).all()
    spread = np.ptp(inside, axis=0) / (camera.width, camera.height)
    assert spread.max() > 0.75  # and from no larger distance than necessary


def test_every_eighth_pixel_of_the_reference(scene, tmp_path, capsys):
    assert main(["render", scene, "--device", "reference", "--every", "8", "-o", "some.png", "--json"]) == 0
    facts = printed_json(capsys)
    assert (facts["width"], facts["height"]) == (20, 15)
    loaded = fs.Scene.load(scene)
    pixels = fs.Renderer("reference").render_subsampled(8, loaded)["rgb"]
    np.testing.assert_array_equal(read_image(tmp_path / "some.png"), to_uint8(pixels))
    for words, why in (
        (
            ("--device", "opencl:pocl", "--every", "8"),
            "--every must be given with --device reference, got opencl:pocl",
        ),
        (
            ("--device", "reference", "--every", "0"),
            "step must be a whole number from 1",
        ),
    ):
        assert main(["render", scene, *words]) == 2
        assert why in capsys.readouterr().err
