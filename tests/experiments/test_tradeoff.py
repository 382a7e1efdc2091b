"""`fidsplat tradeoff`: what is measured, how it is compared with the truth, how a run survives."""

import dataclasses
import json

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.opencl.resident import Resident
from fidsplat.cli import main
from fidsplat.experiments.sweep import read_records
from fidsplat.experiments.tradeoff import compare, run
from fidsplat.experiments.tradeoff import session as session_module
from fidsplat.experiments.tradeoff.hard import CELLS, cell_window, hard_scene
from fidsplat.experiments.tradeoff.linear import linear_error
from fidsplat.experiments.tradeoff.points import (
    ALONE,
    BASE,
    EXACT,
    KNOBS,
    decode_points,
    points,
    quality_of,
    thick_points,
)
from fidsplat.experiments.tradeoff.scenes import NAMES, TradeScene, make, scene_names
from fidsplat.experiments.tradeoff.session import QUICK, Session, memory_of, time_point
from fidsplat.experiments.tradeoff.summary import load
from fidsplat.hard_cases.clouds import camera, splats
from fidsplat.quality import ELLIPSOID, PRESETS, MarkerQuality
from fidsplat.random_clouds import SCENES, random_cloud

pytestmark = pytest.mark.usefixtures("optimised")
FACING = (1.0, 0.0, 0.0, 0.0)
WORDS = ("tradeoff", "--quick", "--scenes", "apriltag", "--knobs", "opacity_ceiling")


@pytest.fixture(scope="module")
def session():
    return Session(fs.Renderer("opencl"))


def faint_rim() -> TradeScene:
    """One opaque splat on black, facing the camera: its rim is what a cut-off takes."""
    cloud = splats([[0.0, 0.0, 2.0]], FACING, (0.2, 0.2), 1.0, (1.0, 0.5, 0.25))
    return TradeScene("rim", cloud, camera(64, 48, 60.0))


def drawn(renderer: fs.Renderer, scene: TradeScene, quality: fs.Quality) -> np.ndarray:
    return renderer.render(scene.cloud, scene.camera, quality=quality, background=scene.background)["rgb"]


def test_every_setting_is_one_knob_away_from_the_base():
    for on_marker in (False, True):
        for point in points(KNOBS, on_marker):
            near = EXACT if point.knob == ALONE else BASE
            turned = {name for name in vars(BASE) if getattr(point.quality, name) != getattr(near, name)}
            if point.knob in vars(BASE):
                # the exclusive stop knows no layers; markers are also drawn without a low-pass
                beside = {"order"} if point.value == "exclusive" else {"lowpass", "samples"}
                wanted = beside if point.knob == "marker" or "order" in beside else set()
                assert turned, point
                assert turned <= {point.knob, *wanted}, point
            elif point.knob == ALONE and point.value != "exact":
                assert point.value.split()[0] in turned


def test_every_knob_is_turned():
    # first_hit decides where depth_first is, and nothing of rgb; detail_error what of a store is drawn, and
    # scenes here are none (docs/large-scenes.md prices it)
    assert {knob.name for knob in dataclasses.fields(fs.Quality)} - set(KNOBS) == {
        "first_hit",
        "detail_error",
    }
    assert {point.quality.ellipsoid for point in thick_points(KNOBS)} == set(ELLIPSOID)
    assert len(thick_points(("samples",))) == 1


def test_the_constants_of_other_systems_are_among_the_options():
    found = {(point.knob, point.value) for point in points(KNOBS, False)}
    assert {
        ("alpha_cutoff", "3 sigma"), ("opacity_ceiling", "0.99"), ("stop_rule", "exclusive"),
        ("lowpass", "none"), ("preset", "gsplat"), (ALONE, "alpha_cutoff 1/255"),
        (ALONE, "transmittance_stop 0.0001"),
    } <= found  # fmt: skip
    assert {point.quality.marker.mixture for point in decode_points(KNOBS)} == {"fitted", "paper", "exact"}


def test_parts_are_all_different_and_the_telling_ones_come_first():
    for quick in (False, True):
        parts = run.all_points((), (), quick)
        assert len({json.dumps(part, sort_keys=True) for part in parts}) == len(parts)
        assert parts[0]["knob"] == "base"
    full = run.all_points((), (), False)
    assert {part["scene"].partition("@")[0] for part in full} == {*NAMES, "ball"}
    knobs = [part.get("knob") for part in full]
    assert knobs.index("blend_precision") > max(i for i, knob in enumerate(knobs) if knob == "alpha_cutoff")
    for point in points(KNOBS, True):
        assert quality_of(json.loads(json.dumps(point.key()))["quality"]) == point.quality
    again = [quality_of(part["quality"]) for part in full if part.get("quality") is not None]
    assert BASE in again
    assert EXACT in again


def test_the_hard_scene_is_the_same_each_time_and_fills_its_cells(session):
    (one, camera_), (other, _) = hard_scene(), hard_scene()
    assert all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in ("means", "scales", "quats")
    )
    assert len(one) > 5000
    assert np.linalg.norm(one.origin) > 1e6
    picture = session.draw("hard", EXACT)["rgb"]
    assert picture.shape == (camera_.height, camera_.width, 3)
    for number, name in enumerate(CELLS):
        assert picture[cell_window(number)].max() > 0.1, name
    # it hurts what it is to hurt: the haze is lost below 1/255, dropped layers let the lamp through
    off = np.abs(session.draw("hard", BASE)["rgb"] - picture)
    assert off[cell_window(CELLS.index("haze"))].max() > 0.1
    dropped = session.draw("hard", BASE.with_(stop_rule="exclusive", order="centre"))["rgb"]
    assert np.abs(dropped - picture)[cell_window(CELLS.index("opaque"))].max() > 0.5


def test_3d_gaussians_are_held_against_the_gaussians_themselves(monkeypatch):
    """What EWA widens and what its linear image is wrong by are errors. A tenth of the scene's splats."""
    small = dataclasses.replace(SCENES["r100k_720p_3d"], count=10_000, width=320, height=180)
    monkeypatch.setitem(SCENES, "r100k_720p_3d", small)
    session = Session(fs.Renderer("opencl"))
    truth = session.truth("r100k_720p_3d", EXACT)
    by_way = {
        point.quality.ellipsoid: np.abs(session.draw("r100k_720p_3d", point.quality)["rgb"] - truth).max()
        for point in thick_points(KNOBS)[1:]
    }
    assert by_way["exact"] < 2e-5
    assert min(by_way["ewa"], by_way["ewa_antialiased"]) > 1e-2


def test_the_linear_image_is_wrong_off_the_axis_and_near():
    assert 0.5 < linear_error(3, 60) < 0.65
    assert linear_error(3, 60) > 3 * linear_error(3, 0) > 10 * linear_error(10, 0)


def test_errors_are_those_of_the_cut_off():
    renderer, scene = fs.Renderer("opencl"), faint_rim()
    cut = fs.Quality(alpha_cutoff=0.1)
    exact = np.asarray(drawn(renderer, scene, EXACT), np.float64)
    result = compare.compare_picture(drawn(renderer, scene, cut), exact, scene, cut)
    # just outside the radius alpha is just below the cut-off
    assert 0.09 < result["maximum"] < 0.1
    assert result["p999"] <= result["maximum"]
    assert result["rmse"] == pytest.approx(np.sqrt(((drawn(renderer, scene, cut) - exact) ** 2).mean()))
    assert result["psnr"] == pytest.approx(-20 * np.log10(result["rmse"]))
    # no pixel's decision hangs on rounding, so certificates take nothing away
    assert result["maximum_sure"] == pytest.approx(result["maximum"], abs=1e-4)
    same = compare.compare_picture(exact.astype(np.float32), exact, scene, EXACT)
    assert same["psnr"] is None or same["psnr"] > 120


def test_a_certified_flip_is_no_error():
    renderer, scene = fs.Renderer("opencl"), faint_rim()
    quality = fs.Quality(alpha_cutoff=0.1)
    truth_of = compare.truth_of(
        compare.Picture(scene.cloud, scene.camera, quality, ("rgb",)),
        tuple(part.ravel() for part in np.mgrid[0:48, 0:64]),
    )
    certificate = truth_of["certificate"].reshape(48, 64)
    off = np.zeros((48, 64))
    row, column = np.unravel_index(np.argmax(certificate), off.shape)
    off[row, column] = certificate[row, column]
    assert compare.beyond_certificates(off, scene, quality) == pytest.approx(0.0, abs=1e-12)
    # an error that nothing certifies stays
    off[24, 32] = 0.3
    assert certificate[24, 32] < 1e-3
    assert compare.beyond_certificates(off, scene, quality) == pytest.approx(0.3, abs=1e-3)
    assert drawn(renderer, scene, quality)[24, 32].max() > 0.9


def test_many_splats_have_no_certificates(monkeypatch):
    monkeypatch.setattr(compare, "_PAIRS", 5)
    assert compare.beyond_certificates(np.zeros((48, 64)), faint_rim(), BASE) is None


def test_a_marker_is_held_against_the_printed_texture(session):
    result = {}
    for mixture in ("fitted", "exact"):
        quality = BASE.with_(marker=MarkerQuality(mixture))
        scene = make("apriltag@60", quality.marker)
        frame, times = time_point(session, "apriltag@60", quality, QUICK)
        result[mixture] = times | compare.compare_marker(frame["rgb"], scene)
    assert result["exact"]["ideal_psnr"] > 50 > result["fitted"]["ideal_psnr"] > 20
    assert result["exact"]["corners_px"] < 0.1
    assert result["exact"]["splats"] == result["exact"]["rectangles"]
    assert result["fitted"]["splats"] > 20 * result["fitted"]["rectangles"]
    for found in result.values():
        assert found["repeats"] >= QUICK.least
        assert found["ms"] > 0
        assert found["base_ms"] > 0
        assert found["memory_bytes"] > 0
        assert found["ratio_quartiles"][0] <= found["ratio"] <= found["ratio_quartiles"][1]


def test_memory_is_that_of_the_setting_alone(session):
    def memory(quality):
        return time_point(session, "apriltag@0", quality, QUICK)[1]["memory_bytes"]

    small = memory(BASE)
    assert memory(BASE.with_(samples=3, lowpass="none")) > 2 * small
    assert memory(BASE) == small


def test_memory_does_not_hang_on_what_was_drawn_before(session, monkeypatch):
    """As on a GPU, where a cloud keeps its colours once a picture has asked for them."""
    held = property(lambda self: sum(buffer.size for buffer in self._buffers.values()))
    monkeypatch.setattr(Resident, "memory_bytes", held)
    before = memory_of(session, "apriltag@0", BASE)
    session.draw("apriltag@0", BASE.with_(samples=2))
    assert before is not None
    assert memory_of(session, "apriltag@0", BASE) == before


def test_a_device_without_float64_is_held_against_one_with_it(session, monkeypatch):
    """As Warp's."""
    monkeypatch.setattr(session_module, "reference_for", lambda *_: session.renderer)
    lacking = fs.Renderer("opencl")
    monkeypatch.setattr(lacking, "render", lambda *_, **__: pytest.fail("it drew its own truth"))
    want = session.truth("apriltag@0", BASE)
    assert np.array_equal(Session(lacking).truth("apriltag@0", BASE), want)


def test_a_definition_has_a_truth_of_its_own(session):
    assert session.truth("apriltag@0", BASE) is session.truth("apriltag@0", BASE.with_(alpha_cutoff=0.01))
    centre = BASE.with_(order="centre")
    assert np.abs(session.truth("apriltag@0", BASE) - session.truth("apriltag@0", centre)).max() > 0.1
    full = session.full("hard", BASE)
    found = compare.check_truth(session.truth("hard", BASE), session.scene("hard", BASE.marker), full)
    assert found["pixels"] == 64
    assert found["maximum"] < 2e-6


def test_nobody_sees_what_standard_leaves_out(session):
    """Half a step of 8 bits, on what constants hurt most."""
    standard = PRESETS["standard"]
    assert np.abs(session.draw("hard", standard)["rgb"] - session.truth("hard", standard)).max() <= 1 / 512


def test_an_interrupted_run_goes_on(capsys, tmp_path, monkeypatch):
    words = [*WORDS, "-o", str(tmp_path), "--json"]
    real, begun = run._begin, []

    def stopped(session, part, quick):
        begun.append(part)
        if len(begun) > 2:
            raise KeyboardInterrupt
        return real(session, part, quick)

    monkeypatch.setattr(run, "_begin", stopped)
    monkeypatch.setattr(run.Options, "workers", 1)
    assert main(words) == 130
    assert "interrupted" in capsys.readouterr().err
    file = tmp_path / run.FILE
    first = file.read_text()
    assert [record.key for record in read_records(file)] == begun[:2]

    monkeypatch.setattr(run, "_begin", real)
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"files": [str(file)], "points": len(read_records(file)), "refused": []}
    assert file.read_text().startswith(first)
    records = read_records(file)
    assert {record.key["what"] for record in records} == {"point", "decode", "truth"}
    # an installed package has no commit
    assert all(record.run["device"] and record.run["code"] and "commit" in record.run for record in records)
    read = {record.key["knob"]: record.result["read"] for record in records if record.key["what"] == "decode"}
    assert read["ideal"].startswith("111")
    assert read["base"].startswith("111")

    before = file.read_bytes()
    assert main(words) == 0  # nothing is left to do
    assert file.read_bytes() == before


def test_ones_own_scene_is_measured_from_each_of_its_poses(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene_file = tmp_path / "own.toml"
    fs.save_ply(random_cloud(200, 0.2), "own.ply")
    scene_file.write_text(
        "[camera]\nwidth = 64\nheight = 48\nfov_x_deg = 60.0\nposition = [0.0, 0.0, 0.0]\n"
        'look_at = [0.0, 0.0, 1.0]\n[[splats]]\nfile = "own.ply"\n'
    )
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n1 0.2 0 0 0 0 0 1\n")
    words = ["tradeoff", "--quick", "--scene", "own.toml", "--cameras", "poses.tum", "-o", "out"]
    words += ["--knobs", "opacity_ceiling"]
    assert main(words) == 0
    records = read_records(tmp_path / "out" / run.FILE)
    views = ("own.toml@0", "own.toml@1")
    found = {(r.key["scene"], r.key["what"], r.key.get("value")): r.result for r in records}
    assert {key[0] for key in found} == set(views)
    assert {key[1] for key in found} == {"point", "truth"}
    for view in views:
        assert found[view, "truth", None]["maximum"] < 1e-5
        assert 1e-4 < found[view, "point", "base"]["maximum"] < 0.05
    # pictures differ, so do their errors; the ceiling lets light through
    assert found[views[0], "point", "base"]["rmse"] != found[views[1], "point", "base"]["rmse"]
    assert found[views[0], "point", "0.99"]["maximum"] >= found[views[0], "point", "base"]["maximum"]
    capsys.readouterr()
    assert load([tmp_path / "out"])[0].scenes == list(views)
    assert main(words) == 0  # nothing is left to do
    fs.save_ply(random_cloud(201, 0.2), "own.ply")
    assert main(words) == 2
    assert "holds results of another scene; give another folder" in capsys.readouterr().err
    assert main(["tradeoff", "--scene", "own.toml", "--scenes", "hard"]) == 2
    assert "exclude each other" in capsys.readouterr().err


def test_several_devices_measure_into_folders_of_their_names(capsys, tmp_path, monkeypatch):
    found = {
        "ratio": 1.0,
        "ratio_quartiles": [0.9, 1.1],
        "base_ms": 2.0,
        "maximum": 0.01,
        "maximum_sure": 0.01,
    }
    begun = []

    def begin(session, key, quick):
        begun.append(session.renderer.device.name)
        return lambda: {**found, "read": "1" * 50}

    monkeypatch.setattr(run, "_begin", begin)
    words = ["tradeoff", "--quick", "--scenes", "hard", "--knobs", "opacity_ceiling", "-o", str(tmp_path)]
    words += ["--device", "opencl:pocl", "--device", "warp:cpu"]
    assert main([*words, "--plot", str(tmp_path / "times.pdf")]) == 2
    assert "--plot is" in capsys.readouterr().err
    assert main([*words[:-1], "opencl:nowhere"]) == 2
    assert not begun  # a device that is not there is said first
    capsys.readouterr()
    assert main([*words, "--plot", str(tmp_path / "both.svg"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["files"] == [str(tmp_path / name / run.FILE) for name in ("opencl-pocl", "warp-cpu")]
    records = [read_records(tmp_path / name / run.FILE) for name in ("opencl-pocl", "warp-cpu")]
    assert said["points"] == len(begun) == sum(map(len, records))
    assert begun == ["opencl:pocl"] * len(records[0]) + ["warp:cpu"] * len(records[1])
    titles = [device.title for device in load([tmp_path / "opencl-pocl", tmp_path / "warp-cpu"])]
    drawn = (tmp_path / "both.svg").read_text()
    assert len(set(titles)) == 2
    assert all(f"<!-- hard on {title} -->" in drawn for title in titles)


def test_ones_own_3d_gaussians_are_held_against_themselves_as_they_are_drawn():
    """Captures look as they did to their trainer, who drew them by EWA."""
    scene = make("r100k_720p_3d", BASE.marker)
    own = Session(fs.Renderer("reference"), {"own.ply": dataclasses.replace(scene, name="own.ply")})
    assert own.definition("own.ply", BASE).ellipsoid == "ewa"
    assert own.definition("own.ply", BASE.with_(ellipsoid="exact")).ellipsoid == "exact"
    assert own.definition("r100k_720p_3d", BASE).ellipsoid == "exact"


def test_what_a_device_refuses_is_a_result(tmp_path, monkeypatch):
    def refuse(*_):
        raise fs.InputError("no such thing here")

    monkeypatch.setattr(run, "_begin", refuse)
    options = run.Options(tmp_path, "opencl", ("apriltag",), ("samples",), quick=True)
    with run.prepared(options) as sweep:
        records = list(sweep.run())
    assert records
    assert all(record.result == {"error": "no such thing here"} for record in records)

    # it may have been the device that failed: another run tries again
    monkeypatch.setattr(run, "_begin", lambda *_: lambda: {"maximum": 0.0})
    for left in (len(records), 0):
        with run.prepared(options) as sweep:
            assert len(sweep.left) == len(list(sweep.run())) == left
    assert [record.result for record in read_records(tmp_path / run.FILE)] == [{"maximum": 0.0}] * len(
        records
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenes", "qr11"], "unknown scene 'qr11' (did you mean 'qr10'?)"),
        (["--knobs", "alpha_cutof"], "unknown knob 'alpha_cutof' (did you mean 'alpha_cutoff'?)"),
        (["--device", "reference"], "give another --device"),
        (["report", "nowhere"], "no results in nowhere"),
    ],
)
def test_wrong_words_are_one_line(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(["tradeoff", *words]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert message in err


@pytest.mark.parametrize("words", [(), ("report",)])
def test_help_teaches(capsys, words):
    assert main(["tradeoff", *words, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"usage: {' '.join(('fidsplat tradeoff', *words))}" in out
    assert "  fidsplat tradeoff report cpu gpu -o docs/accuracy.md" in out


def test_names_of_scenes():
    assert scene_names(()) == NAMES
    assert scene_names(("hard", "hard")) == ("hard",)
