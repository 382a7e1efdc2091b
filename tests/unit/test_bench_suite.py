"""fidsplat bench --suite: renderers in processes of their own, errors, resumption, the format of results."""

import json
from functools import partial
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments.bench import own_adapter, power, regimes, suite
from fidsplat.experiments.bench.regimes import SuiteScene, Views, suite_scenes
from fidsplat.scenes.random_clouds import random_cloud, standard_camera
from fidsplat.util.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
SCHEMA = json.loads((ROOT / "benchmarks" / "splatmark.schema.json").read_text("utf-8"))
CAMERA = standard_camera(48, 36)
TOY = """
import os, time
import numpy as np
class Adapter:
    settings = {"grey": {"disks": {"order": "centre"}}, "bright": {"disks": {"order": "centre"}}}
    facts = {"renderer": "toy", "version": "1", "device": "none", "kind": "cpu", "driver": ""}
    def load(self, scene):
        print("a line of a library")
        assert len(scene["means"]) == 50, "too many splats"
        self.size, self.poses = scene["size"], scene["poses"]
    def render(self, setting, views):
        return np.full((len(views), self.size[1], self.size[0], 3), 1.0 if setting == "bright" else 0.5)
    def read(self, images):
        return images
"""


def views(count: int = 50, poses: int = 1, thick: bool = False) -> Views:
    return Views(
        random_cloud(count, 0.2, thick=thick), CAMERA, np.tile(CAMERA.world_to_camera, (poses, 1, 1))
    )


SCENES = {
    "one": SuiteScene("uniform", "50 disks", views),
    "batch": SuiteScene("batches", "5 views", partial(views, poses=5), batch=True),
    "larger": SuiteScene("uniform", "60 disks", partial(views, 60)),
    "thick": SuiteScene("uniform", "3D Gaussians", partial(views, thick=True)),
    "size@1": SuiteScene("scaling", "one setting", views, x=1.0),
}


@pytest.fixture(autouse=True)
def cheap_references(monkeypatch):
    monkeypatch.setattr(suite, "Renderer", lambda: fs.Renderer("reference"))


def toy(folder: Path, text: str = TOY, name: str = "toy") -> dict:
    (folder / name).mkdir()
    (folder / name / "adapter.py").write_text(text)
    return suite.adapter_renderers(folder)


def run(file: Path, names, renderers, slow: float = 1000.0, **how) -> list[dict]:
    scenes = {name: SCENES[name] for name in names}
    effort = suite.Effort(rounds=3, seconds=0.0, min_rounds=3, burst=0.01, slow=slow)
    return suite.Suite(file, scenes, renderers, effort, "a test", **how).run(lambda step, fraction: None)


def test_results_have_times_and_errors_and_follow_the_schema(tmp_path):
    file = tmp_path / "found.json"
    results = run(file, SCENES, toy(tmp_path))
    written = json.loads(file.read_text())
    assert written["results"] == results
    jsonschema.validate(written, SCHEMA)
    by_scene = {name: [one for one in results if one["scene"] == name] for name in SCENES}
    assert [one["setting"] for one in by_scene["one"]] == ["grey", "bright"]
    assert len(by_scene["size@1"]) == 1
    assert by_scene["thick"] == [
        {"scene": "thick", "renderer": "toy", "skipped": "does not render ellipsoids"}
    ]
    assert by_scene["larger"] == [
        {"scene": "larger", "renderer": "toy", "error": "AssertionError: too many splats"}
    ]
    for one, constant in zip(by_scene["one"], (0.5, 1.0), strict=True):
        exact = fs.Renderer("reference").render(
            views().cloud, CAMERA, quality="alpha_cutoff=1e-8,transmittance_stop=0,order=centre"
        )["rgb"]
        assert one["largest_error"] == pytest.approx(np.abs(constant - exact).max(), rel=1e-4)
        assert one["mean_error"] == pytest.approx(np.abs(constant - exact).mean(), rel=1e-4)
        assert one["frames"] == 3
        assert one["fastest_ms"] <= one["quartiles_ms"][0] <= one["quartiles_ms"][2]
    assert written["scenes"]["batch"]["views"] == 5


def test_a_batch_is_one_submission_timed_per_view(tmp_path):
    slow = TOY.replace("return np.full", "time.sleep(0.02 * len(views)); return np.full")
    results = run(tmp_path / "found.json", ("one", "batch"), toy(tmp_path, slow))
    assert {one["scene"] for one in results} == {"one", "batch"}
    for one in results:
        assert 20 < one["fastest_ms"] < 80  # five views take more than 100 ms


def test_a_run_resumes_and_measures_only_what_is_missing(tmp_path):
    file, renderers = tmp_path / "found.json", toy(tmp_path)
    first = run(file, ("one",), renderers)
    renderers |= toy(tmp_path, TOY.replace("0.5", "0.25"), "other")
    results = run(file, ("one", "batch"), renderers)
    assert results[: len(first)] == first
    assert [(one["scene"], one["renderer"]) for one in results[len(first) :: 2]] == [
        ("one", "other"), ("batch", "toy"), ("batch", "other")
    ]  # fmt: skip
    with pytest.raises(InputError, match="must be of the same effort"):
        suite.Suite(file, SCENES, renderers, suite.QUICK, "a test")
    changed = json.loads(file.read_text())
    changed["run"]["code"] = "of another tree"
    file.write_text(json.dumps(changed))
    with pytest.raises(InputError, match="must be of the same code"):
        run(file, ("one",), renderers)
    assert len(run(file, ("one",), renderers, overwrite=True)) == 4


def test_a_renderer_that_cannot_run_has_a_reason_and_one_that_ends_is_started_again(tmp_path):
    toy(tmp_path, "import package_of_nobody", "absent")
    renderers = toy(tmp_path, TOY.replace("return np.full", "len(views) < 5 or os._exit(3); return np.full"))
    results = run(tmp_path / "found.json", ("batch", "one"), renderers)
    absent = [one for one in results if one["renderer"] == "absent"]
    assert {one["skipped"] for one in absent} == {"ModuleNotFoundError: No module named 'package_of_nobody'"}
    crashed, *later = (one for one in results if one["renderer"] == "toy")
    assert crashed["error"] == "the process ended with status 3"
    assert [one["scene"] for one in later if "frames" in one] == ["one", "one"]


def test_a_slow_renderer_is_measured_at_one_setting_and_a_slower_one_left_out(tmp_path, monkeypatch):
    renderers = toy(tmp_path, TOY.replace("return np.full", "time.sleep(0.02); return np.full"))
    (actual,) = run(tmp_path / "found.json", ("one",), renderers, slow=10.0)
    assert (actual["setting"], actual["frames"]) == ("grey", 3)
    monkeypatch.setattr(suite, "TOO_SLOW", 15.0)
    (actual,) = run(tmp_path / "found.json", ("one",), renderers, slow=10.0, overwrite=True)
    assert actual["skipped"].startswith("a frame takes 0.0")


@pytest.mark.parametrize(
    "made", [views(poses=2), views(thick=True), regimes.tags(True)], ids=lambda v: v.kind
)
def test_our_adapter_renders_the_scene(made, tmp_path):
    adapter = own_adapter.Adapter("reference")
    with np.load(made.save(tmp_path / "scene.npz")) as arrays:
        scene = {name: arrays[name] for name in arrays.files}
    scene["size"], scene["matrix"] = np.array([48, 36]), CAMERA.matrix
    adapter.load(scene)
    every = list(range(len(made.poses)))
    images = adapter.read(adapter.render("standard", every))
    for image, pose in zip(images, made.poses, strict=True):
        frame = fs.Renderer("reference").render(made.cloud, CAMERA.with_pose(pose))
        np.testing.assert_array_equal(image, frame["rgb"])
    assert made.kind in adapter.settings["standard"]


def test_our_adapter_leaves_out_settings_that_the_device_lacks(monkeypatch):
    monkeypatch.setattr(own_adapter, "PRESETS", ("fast", "fast,blend_precision=float16"))
    assert list(own_adapter.Adapter("warp:cpu").settings) == ["fast", own_adapter.EXACT]


def test_a_definition_that_gives_the_same_image_is_rendered_once():
    first_views = views()
    references = suite.References(fs.Renderer("reference"), first_views, [0])
    claims = {"lowpass": "screen", "samples": 1, "order": "auto", "ellipsoid": "ewa"}
    assert references.image(claims) is references.image(claims | {"order": "centre", "ellipsoid": "exact"})
    assert references.image(claims) is not references.image(claims | {"order": "pixel"})


def test_scenes_by_name_regime_and_machine():
    assert set(suite_scenes(["haze", "tags"], False, False)) == {"haze", "tags"}
    assert set(suite_scenes(["street", "batches"], False, False)) == {
        "street", "agents_64", "agents_1024", "agents_4096"
    }  # fmt: skip
    small, every = suite_scenes((), False, False), suite_scenes((), False, True)
    assert set(suite_scenes((), True, True)) < set(small) < set(every)
    assert {"r5m_1080p", "agents_4096"} <= set(every) - set(small)
    with pytest.raises(InputError, match="did you mean 'haze'"):
        suite_scenes(["hazy"], False, False)


def test_generated_scenes_are_in_view_and_of_their_kind():
    scenes = {name: regimes.SUITE[name].make() for name in ("huge", "clusters_3d", "needles", "haze_3d")}
    assert {name: one.kind for name, one in scenes.items()} == {
        "huge": "disks", "clusters_3d": "ellipsoids", "needles": "disks", "haze_3d": "ellipsoids"
    }  # fmt: skip
    assert scenes["haze_3d"].cloud.opacities.max() < 1 / 50
    assert (scenes["needles"].cloud.scales[:, 0] > scenes["needles"].cloud.scales[:, 1]).mean() > 0.99
    assert (scenes["huge"].cloud.scales > 0.3).mean() > 0.005
    shown = scenes["clusters_3d"].camera.project(scenes["clusters_3d"].cloud.means)
    assert ((shown > 0) & (shown < (1280, 720))).all(1).mean() > 0.8
    flight = regimes.street(1000, 3)
    assert flight.poses.shape == (3, 4, 4)
    assert flight.kind == "disks"
    around = regimes.agents(4)
    for pose in around.poses:
        pixels = around.camera.with_pose(pose).project(np.array([[0.0, 0.0, 6.0]]))
        np.testing.assert_allclose(pixels, [[64, 64]], atol=1e-6)


def test_energy_of_a_processor(tmp_path):
    for name, value in (("intel-rapl:0", 5_000_000), ("intel-rapl:1", 1_000_000), ("intel-rapl:0:0", 9)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "energy_uj").write_text(f"{value}\n")
    meter = power._rapl(tmp_path)
    assert meter is not None
    assert meter() == 6.0
    assert power._rapl(tmp_path / "intel-rapl:0") is None


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--quick"], "must be given with --suite"),
        (["--suite", "--json", "-"], "must be given with a FILE as --json"),
        (["--suite", "--scenes", "unifrm"], "did you mean 'uniform'"),
        (["--suite", "--scenes", "tags", "--adapters", "/proc"], "NAME/adapter.py, got /proc"),
    ],
)
def test_words_that_cannot_be_used(words, says, capsys):
    assert main(["bench", *words]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    "file", sorted((ROOT / "benchmarks" / "results").glob("suite-*.json")), ids=lambda file: file.name
)
def test_committed_results_follow_the_schema(file):
    jsonschema.validate(json.loads(file.read_text("utf-8")), SCHEMA)
