"""fidsplat bench: measurements, errors and interrupts, JSON output."""

import json
import xml.dom.minidom

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.opencl.device import OpenCLBackend
from fidsplat.cli import main
from fidsplat.experiments.bench import catalogue, measure
from fidsplat.experiments.bench.ablation import without_effects
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, BenchScene, scene_names
from fidsplat.experiments.bench.measure import overdraw
from fidsplat.experiments.bench.table import scene_table
from fidsplat.scenes.random_clouds import random_cloud, standard_camera
from fidsplat.util.timing import WARM_UP, Timer

CAMERA = standard_camera(64, 48)
# of every record, and of one that has frames
KEYS = (
    *("scene", "renderer", "device", "title", "platform", "driver", "compute_units", "date"),
    *("width", "height", "repeats", "error"),
)
FIGURES = (
    *(
        "frame_ms",
        "quartiles_ms",
        "fastest_ms",
        "first_frame_ms",
        "host_ms",
        "stages_ms",
        "fastest_stages_ms",
        "effects_ms",
    ),
    *("splats", "visible", "pairs", "fragments", "splats_per_second", "memory_bytes", "mean_rgb"),
    *("rates", "rooflines_ms", "times_roofline"),
)


@pytest.fixture(autouse=True)
def small_scenes(monkeypatch):
    for name in ("small", "other"):
        scene = BenchScene("200 splats", lambda: (random_cloud(200, 0.2), CAMERA))
        monkeypatch.setitem(BENCH_SCENES, name, scene)


@pytest.fixture(scope="module")
def known_rates():
    return {}


@pytest.fixture
def rates_once(known_rates, monkeypatch):
    """The rates of a device are measured for the first test alone that needs any."""
    measured = OpenCLBackend.rates

    def rates(self):
        name = self.info.name
        if name not in known_rates:
            known_rates[name] = measured(self)
        return known_rates[name]

    monkeypatch.setattr(OpenCLBackend, "rates", rates)


def bench(*words) -> int:
    return main(["bench", "--repeats", "3", *map(str, words)])


def facing(depths, opacity: float) -> fs.SplatCloud:
    """Splats in the middle of the view that face the camera, one at each depth, ten pixels of sigma."""
    n = len(depths)
    means = np.column_stack([np.zeros((n, 2)), depths])
    scales = np.repeat(np.asarray(depths)[:, None] * 10 / CAMERA.fx, 2, 1)
    return fs.SplatCloud(
        means, np.tile((1.0, 0, 0, 0), (n, 1)), scales, [opacity] * n, colors=np.ones((n, 3))
    )


# --- what is measured


def measurable(renderer):
    """Not all backends are."""
    if not renderer.backend.has("rates"):
        pytest.skip("this backend is not compared with its hardware")
    return renderer.backend


@pytest.mark.usefixtures("optimised")  # else each takes as long as the loop around it
def test_rates_of_a_device_are_those_of_a_computer(renderer):
    assert renderer.device.platform == "NVIDIA Warp" or renderer.backend.has("rates")
    rates = measurable(renderer).rates()
    assert 1e8 < rates.copy_bytes < 1e14
    # results per second; which is faster than which a loaded machine may turn round
    for rate in (rates.fma, rates.exp, rates.division):
        assert 1e6 < rate < 1e16


def test_rendered_fragments_are_counted_exactly(renderer):
    measurable(renderer)

    def count(cloud, **quality):
        return overdraw(renderer, renderer.upload(cloud), CAMERA, fs.Quality(**quality))

    one = facing([2.0], 0.5)
    rendered = count(one)
    assert rendered.shape == (48, 64)
    assert rendered.dtype == np.int32
    alpha = renderer.render(one, CAMERA, outputs=("alpha",))["alpha"]
    np.testing.assert_array_equal(rendered, (alpha > 0).astype(np.int32))
    np.testing.assert_array_equal(count(facing([2.0, 2.5, 3.0], 0.1)), 3 * count(facing([2.0], 0.1)))
    # nothing is rendered behind what lets no light through, here 1 - 0.9 a layer
    stack = count(facing([2.0, 2.1, 2.2, 2.3, 2.4], 0.9), transmittance_stop=0.05)
    assert stack[24, 32] == 2
    assert stack.max() == 5  # towards the rim every layer lets light through
    # a layer is made of as many fragments as lie in it
    printed = facing([2.0, 2.0, 2.0], 0.5).with_coplanar_groups(0)
    np.testing.assert_array_equal(count(printed), 3 * rendered)
    assert count(one, samples=2).sum() == pytest.approx(4 * rendered.sum(), rel=0.02)


def test_fragments_are_counted_through_the_lens(renderer):
    """A lens has its own kernels."""
    measurable(renderer)
    camera = fs.Camera.pinhole(64, 48, CAMERA.fx, CAMERA.fy, 32, 24, lens=fs.BrownConrady(-0.3, 0.1))
    spread = random_cloud(200, 0.2)
    counted = overdraw(renderer, renderer.upload(spread), camera, fs.Quality(transmittance_stop=0.0))
    alpha = renderer.render(spread, camera, ("alpha",), fs.Quality(transmittance_stop=0.0))["alpha"]
    np.testing.assert_array_equal(counted > 0, alpha > 0)


def test_the_count_is_not_a_public_output(renderer):
    with pytest.raises(fs.InputError, match="unknown output 'overdraw'"):
        renderer.render(facing([2.0], 0.5), CAMERA, outputs=("overdraw",))


def test_memory_is_of_cloud_buffers_and_image(renderer):
    before = measurable(renderer).memory_bytes
    resident = renderer.upload(random_cloud(1000, 0.1))
    assert renderer.backend.memory_bytes == before  # a cloud is no scratch
    frame = renderer.render(resident, standard_camera(640, 480))
    assert resident.memory_bytes in (0, 1000 * 4 * (3 + 4 + 2 + 1 + 3))  # 0: the host's own arrays
    assert (resident.memory_bytes == 0) == (renderer.device.kind == "cpu")
    held = renderer.backend.memory_bytes
    assert held >= 640 * 480 * 16  # samples: colours and transmittance
    del frame
    assert renderer.backend.memory_bytes >= held  # an image that is given back is kept for the next image


@pytest.mark.usefixtures("rates_once")
def test_devices_are_interleaved(monkeypatch):
    turns = []
    draw = measure.SceneRun.render

    def noted(self):
        turns.append(self.renderer.device.name)
        return draw(self)

    monkeypatch.setattr(measure.SceneRun, "render", noted)
    running = measure.Bench(["reference", "opencl"], lambda words: None, lambda: None)
    running.run("small", 2)
    first, second = (result.device.name for result in running.results)
    assert turns[-4:] == [first, second, second, first]
    assert [len(result.timer.ms) for result in running.results] == [2, 2]
    reference = running.results[0].as_dict()
    assert reference["rates"] is None
    assert reference["memory_bytes"] is None
    assert reference["times_roofline"] == {}
    assert running.results[1].as_dict()["mean_rgb"] == pytest.approx(reference["mean_rgb"], abs=1e-5)


# --- the command


@pytest.mark.usefixtures("rates_once")
def test_json_on_stdout_is_the_only_output(capsys):
    assert bench("--scenes", "small", "other", "--json", "-") == 0
    content = json.loads(capsys.readouterr().out)
    assert content["scenes"] == ["small", "other"]
    assert content["interrupted"] is False
    assert [record["scene"] for record in content["results"]] == ["small", "other"]
    for record in content["results"]:
        assert tuple(record) == KEYS + FIGURES
        assert record["repeats"] == 3
        assert record["error"] is None
        low, high = record["quartiles_ms"]
        assert 0 < record["fastest_ms"] <= low <= record["frame_ms"] <= high
        assert sum(record["fastest_stages_ms"].values()) <= high
        assert 0 < record["visible"] <= record["splats"] == 200
        assert 0 < record["pairs"] < record["fragments"]
        assert set(record["times_roofline"]) == {"frame", *record["stages_ms"]}
        assert record["times_roofline"]["frame"] == pytest.approx(
            record["frame_ms"] / sum(record["rooflines_ms"].values())
        )


@pytest.mark.usefixtures("rates_once")
def test_a_table_for_people_and_a_file_for_programs(capsys, tmp_path):
    file = tmp_path / "figures.json"
    assert bench("--scenes", "small", "--json", file) == 0
    out = capsys.readouterr().out
    for words in ("small: 200 splats", "x roofline", "blend", "splats/s", "memory", "3 frames"):
        assert words in out
    assert json.loads(file.read_text())["results"][0]["scene"] == "small"


@pytest.mark.usefixtures("rates_once")
def test_an_interrupt_keeps_what_was_measured(capsys, tmp_path, monkeypatch):
    draws = []

    def stopped(self, timed=True, run=Timer.run):
        draws.append(timed)
        if len(draws) == 2 * (1 + WARM_UP) + 3 + 2:  # the second frame of the second scene
            raise KeyboardInterrupt
        return run(self, timed)

    monkeypatch.setattr(Timer, "run", stopped)
    file = tmp_path / "figures.json"
    assert bench("--scenes", "small", "other", "--json", file) == 130
    out, err = capsys.readouterr()
    assert "small: 200 splats" in out
    assert "other: 200 splats" in out
    assert err.endswith("fidsplat: interrupted\n")
    content = json.loads(file.read_text())
    assert content["interrupted"] is True
    assert [record["repeats"] for record in content["results"]] == [3, 1]


@pytest.mark.usefixtures("rates_once")
def test_what_a_device_cannot_render_is_reported_and_the_rest_is_rendered(capsys, monkeypatch):
    def refuse_empty(self, scene, upload=fs.Renderer.upload):
        if len(scene) == 0:
            raise fs.DeviceError("no memory for this")
        return upload(self, scene)

    monkeypatch.setattr(fs.Renderer, "upload", refuse_empty)
    monkeypatch.setitem(BENCH_SCENES, "other", BenchScene("empty", lambda: (fs.SplatCloud.empty(), CAMERA)))
    assert bench("--scenes", "other", "small", "--json", "-") == 1
    failed, rendered = json.loads(capsys.readouterr().out)["results"]
    assert failed["error"] == "no memory for this"
    assert tuple(failed) == KEYS
    assert rendered["repeats"] == 3
    assert bench("--scenes", "other", "small") == 1
    assert "other on opencl" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--scenes", "smal"], "did you mean 'small'"),
        (["--repeats", "0"], "at least 1"),
        (["--device", "opencl:nonsense"], "nonsense"),
        (["--json", "/proc/nowhere/figures.json"], "/proc/nowhere"),
    ],
)
def test_words_that_cannot_be_used(words, says, capsys):
    assert main(["bench", *words]) == 2
    assert says in capsys.readouterr().err


# --- scenes


def test_names_of_scenes():
    assert scene_names(()) == catalogue.DEFAULT_SCENES
    assert set(scene_names(["all"])) == set(BENCH_SCENES)
    assert scene_names(["tag", "r1m_1080p", "tag"]) == ("tag", "r1m_1080p")


def test_the_help_names_every_scene(capsys):
    assert main(["bench", "--help"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in BENCH_SCENES if name not in ("small", "other"))


def test_the_tag_is_in_the_middle_of_its_image():
    cloud, camera = catalogue.tag()
    shown = camera.project(cloud.means + cloud.origin)
    np.testing.assert_allclose(shown.mean(0), (320, 240), atol=5)
    assert shown.min() > 0
    assert 160 < np.ptp(shown[:, 1]) < 210  # with its quiet zone


def test_the_wall_fills_the_image_with_200_codes(monkeypatch):
    plain = fs.marker("qr-v1-L:a", size=0.1, quiet_zone=0)  # made at once, and no larger than a dense one
    requested = []
    monkeypatch.setattr(catalogue, "marker", lambda spec, size: requested.append((spec, size)) or plain)
    cloud, camera = catalogue.qr_wall()
    assert len(cloud) == 200 * len(plain.cloud)
    assert len(requested) == len(set(requested)) == 10
    assert all(spec.startswith("qr-v22-L:") and len(spec) == 1009 and size == 0.1 for spec, size in requested)
    shown = camera.project(cloud.means + cloud.origin)
    assert shown.min() > 0
    assert np.all(shown.max(0) < (1920, 1080))
    assert np.ptp(shown[:, 0]) > 0.9 * 1920


def test_ones_own_scene_from_ones_own_cameras(tmp_path, monkeypatch, capsys):
    """Each pose is timed separately, up to a maximum number, and renders its own view."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(catalogue, "MOST_VIEWS", 3)
    fs.save_ply(random_cloud(50, 0.2), "own.ply")
    (tmp_path / "own.toml").write_text(
        "[camera]\nwidth = 24\nheight = 18\nfov_x_deg = 60.0\nposition = [0.0, 0.0, 0.0]\n"
        'look_at = [0.0, 0.0, 1.0]\n[[splats]]\nfile = "own.ply"\n'
    )
    lines = [f"{k} {0.1 * k} 0 0 0 0 0 1" for k in range(5)]
    (tmp_path / "poses.tum").write_text("\n".join(lines))
    words = ("--scene", "own.toml", "--device", "reference")
    assert bench(*words, "--cameras", "poses.tum", "--json", "-") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["scenes"] == [f"own.toml@{k}" for k in (0, 2, 4)]
    cloud, renderer = fs.load_ply("own.ply"), fs.Renderer("reference")
    f = 12 / np.tan(np.radians(30))
    for k, result in zip((0, 2, 4), printed["results"], strict=True):
        pose = np.eye(4)
        pose[0, 3] = -0.1 * k
        camera = fs.Camera.pinhole(24, 18, f, f, 12, 9, pose)
        rendered = renderer.render(cloud, camera)["rgb"]
        assert result["effects_ms"] == {}
        assert result["mean_rgb"] == pytest.approx(float(rendered.mean(dtype=np.float64)), rel=1e-5)
    assert bench(*words) == 0
    out = capsys.readouterr().out
    assert "own.toml: 50 splats, 24 x 18" in out
    assert "more with --scenes" not in out
    for wrong, why in (
        (("--scene", "own.toml", "--scenes", "small"), "must not be given together"),
        (("--cameras", "poses.tum"), "--cameras must be given together with --scene FILE"),
    ):
        assert bench(*wrong) == 2
        assert why in capsys.readouterr().err


REQUESTS = """
[camera]
width = 16
height = 12
fov_x_deg = 60.0
[camera.distortion]
k1 = -0.1
[camera.shutter]
exposure_time_ms = 20.0
sub_poses = 2
[[camera.motion]]
time = -1.0
position = [0.0, 0.0, 0.0]
look_at = [0.0, 0.0, 1.0]
[[camera.motion]]
time = 1.0
position = [0.4, 0.0, 0.0]
look_at = [0.4, 0.0, 1.0]
[[splats]]
file = "own.ply"
[[markers]]
spec = "apriltag:36h11:5"
size = 0.5
position = [0.0, 0.0, 1.5]
[render]
outputs = ["rgb", "depth"]
quality = "fast"
"""


def test_ones_own_scene_with_everything_it_requests(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    fs.save_ply(random_cloud(20, 0.2), "own.ply")
    (tmp_path / "own.toml").write_text(REQUESTS)
    words = ("--device", "reference", "--repeats", "1", "--json", "-")
    assert main(["bench", "--scene", "own.toml", *words]) == 0
    (result,) = json.loads(capsys.readouterr().out)["results"]
    assert set(result["effects_ms"]) == {"lens", "shutter", "order", "outputs", "markers"}
    assert result["repeats"] == 1
    scene = fs.Scene.load("own.toml")
    image = fs.Renderer("reference").render(scene)["rgb"]
    assert result["mean_rgb"] == pytest.approx(float(image.mean(dtype=np.float64)), rel=1e-5)
    assert result["splats"] == len(scene.cloud()) > 20
    assert result["rooflines_ms"] == {}
    less = without_effects(scene, scene.capture)
    assert less["lens"].capture.camera.lens is None
    assert not less["shutter"].capture.has_sub_frames
    assert less["outputs"].capture.outputs == ("rgb",)
    assert len(less["markers"].cloud()) == 20
    assert all(one.cloud() is None for name, one in less.items() if name != "markers")


def test_a_scenes_shutter_moves_along_the_cameras(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fs.save_ply(random_cloud(20, 0.2), "own.ply")
    (tmp_path / "own.toml").write_text(REQUESTS)
    path = fs.Trajectory([0.0, 1.0], np.array([np.eye(4), np.eye(4) + 0.3 * np.eye(4, k=3)]))
    scenes = catalogue.user_scenes("own.toml", fs.Scene.load("own.toml"), path)
    first = scenes["own.toml@0"].capture
    np.testing.assert_allclose(np.linalg.inv(first.motion.camera_at(0.5))[:3, 3], (0.15, 0, 0), atol=1e-12)
    np.testing.assert_allclose(scenes["own.toml@1"].make()[1].position, (0.3, 0, 0), atol=1e-12)
    assert first.has_sub_frames


def test_the_table_shows_the_share_of_each_effect():
    timer, less = Timer(lambda: None), Timer(lambda: None)
    timer.ms, less.ms = [10.0, 12.0, 14.0], [4.0, 6.0, 11.0]
    device = fs.Renderer("reference").device
    result = measure.Result("own", device, 8, 8, timer, counts={"splats": 5}, without={"fog": less})
    assert result.effects == {"fog": 6.0}
    less.ms.append(90.0)  # interrupted before the last frame of the scene
    assert result.effects == {"fog": 6.0}
    assert ["of which fog", "6.00 (50 %)", ""] in scene_table([result])[1]


@pytest.mark.usefixtures("rates_once")
def test_the_plot_has_a_bar_for_each_scene_and_device(tmp_path):
    pytest.importorskip("matplotlib", reason="the extra experiments is not installed")
    file = tmp_path / "times.svg"
    words = ("--device", "reference", "--device", "opencl:pocl")
    assert bench("--scenes", "small", "other", *words, "--plot", file) == 0
    rendered = xml.dom.minidom.parse(str(file)).toxml()
    for words in ("small", "other", "opencl:pocl", "reference", "ms per frame", "quartiles", "roofline:"):
        assert f"<!-- {words}" in rendered, words


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("times.pdf", "ends in .svg or .png"),
        ("no/../\0.svg", "a path must be text"),
        (".", "ends in .svg or .png"),
    ],
)
def test_a_plot_that_cannot_be_written_is_said_first(name, words, capsys):
    assert bench("--scenes", "small", "--plot", name) == 2
    assert words in capsys.readouterr().err
