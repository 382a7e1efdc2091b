"""`fidsplat tradeoff`: measurements, and their comparison with the reference."""

import dataclasses
import json

import numpy as np
import pytest
from ewa_error import linear_error

import fidsplat as fs
from fidsplat.capture.quality import ELLIPSOID, PRESETS, MarkerQuality
from fidsplat.experiments.tradeoff import run, scenes
from fidsplat.experiments.tradeoff import session as session_module
from fidsplat.experiments.tradeoff.points import (
    ABLATION,
    BASE,
    EXACT,
    SETTINGS,
    ellipsoid_points,
    points,
    quality_of,
)
from fidsplat.experiments.tradeoff.scenes import NAMES, TradeScene, make_view
from fidsplat.experiments.tradeoff.session import QUICK, Session, time_point
from fidsplat.scenes.random_clouds import SCENES
from fidsplat.selftest.clouds import camera, splats
from fidsplat.selftest.hard_scene import CELL, COLUMNS, hard_scene

pytestmark = pytest.mark.usefixtures("optimised")
FACING = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module", autouse=True)
def small_images():
    """Of markers: 400 x 400 pixels instead of 800 x 800."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "PROTOCOL", dataclasses.replace(scenes.PROTOCOL, pixels=400))
        yield


@pytest.fixture(scope="module")
def session():
    return Session(fs.Renderer("opencl"))


def faint_rim() -> TradeScene:
    """One opaque splat on black that faces the camera: a cut-off removes its rim."""
    cloud = splats([[0.0, 0.0, 2.0]], FACING, (0.2, 0.2), 1.0, (1.0, 0.5, 0.25))
    return TradeScene("rim", cloud, camera(64, 48, 60.0))


def rendered(renderer: fs.Renderer, scene: TradeScene, quality: fs.Quality) -> np.ndarray:
    return renderer.render(scene.cloud, scene.camera, quality=quality, background=scene.background)["rgb"]


def test_every_setting_changes_one_option_of_the_base():
    for on_marker in (False, True):
        for point in points(SETTINGS, on_marker):
            near = EXACT if point.setting == ABLATION else BASE
            turned = {name for name in vars(BASE) if getattr(point.quality, name) != getattr(near, name)}
            if point.setting in vars(BASE):
                # the exclusive stop knows no layers; markers are also rendered without a low-pass
                beside = {"order"} if point.value == "exclusive" else {"lowpass", "samples"}
                expected = beside if point.setting == "marker" or "order" in beside else set()
                assert turned, point
                assert turned <= {point.setting, *expected}, point
            elif point.setting == ABLATION and point.value != "exact":
                assert point.value.split()[0] in turned


def test_every_quality_setting_is_varied():
    # first_hit decides where depth_first is, and nothing of rgb; detail_error what of a store is rendered,
    # and scenes here are none (docs/large-scenes.md prices it)
    assert {setting.name for setting in dataclasses.fields(fs.Quality)} - set(SETTINGS) == {
        "first_hit",
        "detail_error",
    }
    assert {point.quality.ellipsoid for point in ellipsoid_points(SETTINGS)} == set(ELLIPSOID)
    assert len(ellipsoid_points(("samples",))) == 1


def test_the_constants_of_other_systems_are_among_the_options():
    actual = {(point.setting, point.value) for point in points(SETTINGS, False)}
    assert {
        ("alpha_cutoff", "3 sigma"), ("opacity_ceiling", "0.99"), ("stop_rule", "exclusive"),
        ("lowpass", "none"), ("preset", "gsplat"), (ABLATION, "alpha_cutoff 1/255"),
        (ABLATION, "transmittance_stop 0.0001"),
    } <= actual  # fmt: skip
    assert {point.quality.marker.mixture for point in points(SETTINGS, True)} == {"fitted", "paper", "exact"}


def test_parts_are_all_different_and_the_informative_ones_come_first():
    for quick in (False, True):
        parts = run.all_points((), (), quick)
        assert len({json.dumps(part, sort_keys=True) for part in parts}) == len(parts)
        assert parts[0]["setting"] == "base"
    full = run.all_points((), (), False)
    assert {part["scene"].partition("@")[0] for part in full} == set(NAMES)
    settings = [part.get("setting") for part in full]
    last_cutoff = max(i for i, setting in enumerate(settings) if setting == "alpha_cutoff")
    assert settings.index("blend_precision") > last_cutoff
    for point in points(SETTINGS, True):
        assert quality_of(json.loads(json.dumps(point.key()))["quality"]) == point.quality
    again = [quality_of(part["quality"]) for part in full if part.get("quality") is not None]
    assert BASE in again
    assert EXACT in again


def cell_window(number):
    """Rows and columns of the image that a cell of the hard scene covers."""
    row, column = divmod(number, COLUMNS)
    return slice(row * CELL[1], (row + 1) * CELL[1]), slice(column * CELL[0], (column + 1) * CELL[0])


def test_the_hard_scene_is_the_same_each_time_and_fills_its_cells(session):
    (one, camera_), (other, _) = hard_scene(), hard_scene()
    assert all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in ("means", "scales", "quats")
    )
    assert len(one) > 5000
    assert np.linalg.norm(one.origin) > 1e6
    image = session.render("hard", EXACT)["rgb"]
    assert image.shape == (camera_.height, camera_.width, 3)
    for number in range(8):
        assert image[cell_window(number)].max() > 0.1
    # it hurts what it is to hurt: the haze is lost below 1/255, dropped layers let the lamp through
    off = np.abs(session.render("hard", BASE)["rgb"] - image)
    assert off[cell_window(0)].max() > 0.1
    dropped = session.render("hard", BASE.with_(stop_rule="exclusive", order="centre"))["rgb"]
    assert np.abs(dropped - image)[cell_window(2)].max() > 0.5


@pytest.mark.sweep
def test_3d_gaussians_are_compared_with_the_gaussians_themselves(monkeypatch):
    """The widening and the linearisation of EWA are errors. A few splats of the scene."""
    small = dataclasses.replace(SCENES["r100k_720p_3d"], count=3_000, width=160, height=90)
    monkeypatch.setitem(SCENES, "r100k_720p_3d", small)
    session = Session(fs.Renderer("opencl"))
    expected = session.reference("r100k_720p_3d", EXACT)
    by_way = {
        point.quality.ellipsoid: np.abs(
            session.render("r100k_720p_3d", point.quality)["rgb"] - expected
        ).max()
        for point in ellipsoid_points(SETTINGS)[1:]
    }
    assert by_way["exact"] < 2e-5
    assert min(by_way["ewa"], by_way["ewa_antialiased"]) > 1e-2


def test_the_linear_image_is_wrong_off_the_axis_and_near():
    assert 0.5 < linear_error(3, 60) < 0.65
    assert linear_error(3, 60) > 3 * linear_error(3, 0) > 10 * linear_error(10, 0)


def test_errors_are_those_of_the_cut_off():
    renderer, scene = fs.Renderer("opencl"), faint_rim()
    cut = fs.Quality(alpha_cutoff=0.1)
    exact = np.asarray(rendered(renderer, scene, EXACT), np.float64)
    result = session_module.compare_image(rendered(renderer, scene, cut), exact, scene, cut)
    # just outside the radius alpha is just below the cut-off
    assert 0.09 < result["maximum"] < 0.1
    assert result["rmse"] == pytest.approx(np.sqrt(((rendered(renderer, scene, cut) - exact) ** 2).mean()))
    # no pixel's decision hangs on rounding, so error bounds take nothing away
    assert result["maximum_sure"] == pytest.approx(result["maximum"], abs=1e-4)
    assert session_module.compare_image(exact.astype(np.float32), exact, scene, EXACT)["rmse"] < 1e-6


def test_a_certified_flip_is_not_an_error():
    renderer, scene = fs.Renderer("opencl"), faint_rim()
    quality = fs.Quality(alpha_cutoff=0.1)
    reference = session_module.reference_images(
        session_module.FrameSpec(scene.cloud, scene.camera, quality, ("rgb",)),
        tuple(part.ravel() for part in np.mgrid[0:48, 0:64]),
    )
    error_bound = reference["error_bound"].reshape(48, 64)
    off = np.zeros((48, 64))
    row, column = np.unravel_index(np.argmax(error_bound), off.shape)
    off[row, column] = error_bound[row, column]
    assert session_module.beyond_error_bounds(off, scene, quality) == pytest.approx(0.0, abs=1e-12)
    # an error that nothing certifies stays
    off[24, 32] = 0.3
    assert error_bound[24, 32] < 1e-3
    assert session_module.beyond_error_bounds(off, scene, quality) == pytest.approx(0.3, abs=1e-3)
    assert rendered(renderer, scene, quality)[24, 32].max() > 0.9


def test_many_splats_have_no_error_bounds(monkeypatch):
    monkeypatch.setattr(session_module, "_PAIRS", 5)
    assert session_module.beyond_error_bounds(np.zeros((48, 64)), faint_rim(), BASE) is None


def test_a_marker_is_compared_with_the_printed_texture(session):
    result = {}
    for mixture in ("fitted", "exact"):
        quality = BASE.with_(marker=MarkerQuality(mixture))
        scene = make_view("apriltag@60", quality.marker)
        frame, times = time_point(session, "apriltag@60", quality, QUICK)
        result[mixture] = times | session_module.compare_marker(frame["rgb"], scene)
    assert result["exact"]["ideal_psnr"] > 50 > result["fitted"]["ideal_psnr"] > 20
    assert result["exact"]["corners_px"] < 0.1
    assert result["exact"]["splats"] == result["exact"]["rectangles"]
    assert result["fitted"]["splats"] > 20 * result["fitted"]["rectangles"]
    for actual in result.values():
        assert actual["repeats"] >= QUICK.minimum
        assert actual["ms"] > 0
        assert actual["base_ms"] > 0
        assert actual["ratio_quartiles"][0] <= actual["ratio"] <= actual["ratio_quartiles"][1]


def test_a_device_without_float64_is_compared_with_one_with_it(session, monkeypatch):
    """As Warp's."""
    monkeypatch.setattr(session_module, "reference_renderer", lambda *_: session.renderer)
    lacking = fs.Renderer("opencl")
    monkeypatch.setattr(lacking, "render", lambda *_, **__: pytest.fail("it drew its own truth"))
    want = session.reference("apriltag@0", BASE)
    assert np.array_equal(Session(lacking).reference("apriltag@0", BASE), want)


def test_a_definition_has_a_truth_of_its_own(session):
    assert session.reference("apriltag@0", BASE) is session.reference(
        "apriltag@0", BASE.with_(alpha_cutoff=0.01)
    )
    center = BASE.with_(order="centre")
    assert np.abs(session.reference("apriltag@0", BASE) - session.reference("apriltag@0", center)).max() > 0.1


@pytest.mark.sweep
def test_omissions_of_standard_are_invisible(session):
    """The error is within half an 8-bit level on the scenes that constants change most."""
    standard = PRESETS["standard"]
    assert (
        np.abs(session.render("hard", standard)["rgb"] - session.reference("hard", standard)).max() <= 1 / 512
    )


def test_captured_3d_gaussians_are_compared_with_themselves():
    """Captures are rendered by EWA, as in their training."""
    scene = make_view("r100k_720p_3d", BASE.marker)
    own = Session(fs.Renderer("reference"), {"own.ply": dataclasses.replace(scene, name="own.ply")})
    assert own.definition("own.ply", BASE).ellipsoid == "ewa"
    assert own.definition("own.ply", BASE.with_(ellipsoid="exact")).ellipsoid == "exact"
    assert own.definition("r100k_720p_3d", BASE).ellipsoid == "exact"
