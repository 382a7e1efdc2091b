"""`fs.quality_within`: its promises hold on scenes that its candidates were not measured with."""

import dataclasses
import json
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from brute_force import ideal
from random_scenes import HELD_OUT, random_scene

import fidsplat as fs
from fidsplat.accuracy import candidates, quality_within, search
from fidsplat.accuracy.candidates import Choice
from fidsplat.accuracy.certification import certify
from fidsplat.accuracy.error import errors, reference_image
from fidsplat.accuracy.quality_within import _key, choose
from fidsplat.util.errors import InputError
from fidsplat.util.timing import Clock, Timer

BACKEND = "opencl"
BOUNDS = (1e-2, 1e-3, 1e-4)
HELD_OUT_SCENES = 16
AWAY = np.eye(4) + np.outer([0, 0, 1, 0], [0, 0, 0, 3.0])  # 3 m
SMALL = fs.Camera.pinhole(2, 2, 1.0, 1.0, 1.0, 1.0)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """A cache folder of this test."""
    monkeypatch.setattr(quality_within, "cache_folder", lambda: tmp_path / "cache")


@pytest.fixture(scope="module")
def scene():
    return random_scene(HELD_OUT + 1)


@pytest.fixture(scope="module")
def held_out(reference):
    """Held-out scenes with their reference images."""
    scenes = [random_scene(HELD_OUT + k) for k in range(HELD_OUT_SCENES)]
    return [
        (s, reference_image(reference, s.cloud, fs.Capture(s.camera, background=s.background)))
        for s in scenes
    ]


def error_of(renderer, scene, quality, want):
    frame = renderer.render(scene.cloud, scene.camera, quality=quality, background=scene.background)
    return errors(frame["rgb"], want).maximum


def within(renderer, scene, error=None, ms=None, **more):
    capture = fs.Capture(scene.camera, background=scene.background).with_(**more)
    return choose(error, ms, scene.cloud, capture, renderer)


# candidates


def test_candidates_are_sorted_by_cost():
    front = candidates.load("cpu")
    assert [s.cost for s in front] == sorted(s.cost for s in front)
    assert all(0 < s.error_easy <= s.error_median <= s.error_max for s in front)
    assert all(isinstance(s.quality(fs.Quality()), fs.Quality) for s in front)
    assert candidates.load("an unknown kind") == front


@pytest.mark.parametrize("error", BOUNDS)
def test_a_promised_error_holds(renderer, held_out, error):
    """benchmarks/quality_within_promise.py is the long form with 200 scenes."""
    quality = fs.quality_within(error=error, device=renderer)
    actual = [error_of(renderer, scene, quality, want) for scene, want in held_out]
    assert max(actual) <= error, actual


def layers(count, opacity, color=1.0):
    """Splats that fill the image of SMALL, one behind the other."""
    means = np.column_stack([np.zeros((count, 2)), np.linspace(1.0, 2.0, count)])
    arrays = means, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 2), 1e3), np.full(count, opacity)
    return fs.SplatCloud(*arrays, colors=np.full((count, 3), color))


@pytest.mark.parametrize(
    ("error", "count", "colors"),
    [(0.1, 100, 1.0), (1e-2, 100, 1.0), (1e-3, 1000, 1.0), (1e-4, 100, 1.0), (1e-2, 100, 1000.0)],
)
def test_the_promise_names_its_class_of_scenes(renderer, error, count, colors):
    """The hardest scene of the class: the maximum number of layers just below the cut-off."""
    quality = fs.quality_within(error, device=renderer, faint_fragments=count, colors=colors)
    haze = layers(count, 0.99 * quality.alpha_cutoff, colors)
    light = fs.SplatCloud.concatenate([layers(30, 0.5, 0.0), layers(1, 1.0, colors).transformed(AWAY)])
    for cloud in (haze, light):
        frame = renderer.render(cloud, SMALL, quality=quality)
        assert errors(frame["rgb"], ideal(cloud, SMALL, quality)).maximum <= error
    choice = choose(error, device=renderer, faint_fragments=count, colors=colors)
    assert f"range of {colors:g} and at most {count} faint fragments" in choice.summary


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"faint_fragments": 10**9}, "at most 1000000000 faint fragments"),
        ({"colors": 1e9}, r"range of 1e\+09"),
        ({"faint_fragments": 0}, "faint_fragments must be .* got 0"),
        ({"colors": 0}, "got 0"),
    ],
)
def test_a_class_of_scenes_without_a_promise(renderer, words, message):
    with pytest.raises(InputError, match=message):
        fs.quality_within(1e-3, device=renderer, **words)


def coarse(renderer):
    """A choice that was not measured."""
    return Choice(fs.Quality.named("fast"), 0.0, 1.0, 1.0, "measured", renderer.device.name, {})


def test_a_choice_is_refined_until_certified(renderer):
    haze = layers(300, 1e-3)
    scene = fs.Scene([haze], camera=SMALL)
    choice = certify(coarse(renderer), 1e-3, None, scene, scene.capture, renderer)
    assert choice.certified <= 1e-3
    assert choice.quality.alpha_cutoff > 1e-6
    off = errors(renderer.render(scene, quality=choice.quality)["rgb"], ideal(haze, SMALL, choice.quality))
    assert off.maximum <= choice.certified
    again = certify(choice, 1e-3, None, scene, scene.capture, renderer)
    assert again.quality == choice.quality
    with pytest.raises(InputError, match=r"error must be at least .* to be certified"):
        certify(choice, 1e-9, None, scene, scene.capture, renderer)
    with pytest.raises(InputError, match=r"ms must be at least .* for a certified error of 0.001, got"):
        certify(coarse(renderer), 1e-3, 1e-6, scene, scene.capture, renderer)


def test_a_choice_without_an_error_bound_has_a_remark(renderer):
    scene = fs.Scene([layers(3, 0.5)], camera=SMALL, fog=fs.Fog(0.1))
    choice = certify(coarse(renderer), 1e-3, None, scene, scene.capture, renderer)
    assert choice.certified is None
    assert "not certified: the output 'error' must" in choice.summary
    assert "fog" in choice.summary


def test_a_lower_error_is_never_faster(renderer):
    cost = {json.dumps(s.settings): s.cost for s in candidates.load(renderer.device.kind)}
    chosen = [choose(error, device=renderer) for error in (0.3, *BOUNDS)]
    assert all(choice.error <= error for choice, error in zip(chosen, (0.3, *BOUNDS), strict=True))
    costs = [cost[json.dumps(choice.settings)] for choice in chosen]
    assert costs == sorted(costs)
    assert costs[0] < costs[-1]


def test_the_definition_stays():
    base = fs.Quality(lowpass="pixel", samples=3, order="centre", first_hit=0.3)
    definition = ("lowpass", "samples", "order", "first_hit", "marker")
    for candidate in candidates.load("cpu"):
        assert all(getattr(candidate.quality(base), name) == getattr(base, name) for name in definition)
        parity = candidate.quality(fs.Quality.named("gsplat"))
        assert (parity.opacity_ceiling, parity.stop_rule, parity.order) == (1.0, "inclusive", "centre")


# measured errors


def test_a_measured_error_is_the_error(renderer, held_out):
    for scene, want in held_out[:6]:
        for bound in BOUNDS:
            choice = within(renderer, scene, bound)
            actual = error_of(renderer, scene, choice.quality, want)
            assert actual <= bound
            assert choice.error == pytest.approx(actual, abs=1e-6)  # the device's truth is rounded to float32
            assert choice.source == "measured"


def test_the_error_of_the_reference_is_added(renderer, held_out, monkeypatch):
    scene, _ = held_out[0]
    capture = fs.Capture(scene.camera, background=scene.background)

    def measured():
        return search.SceneMeasurement(renderer, scene.cloud, capture, lambda text: None).error(fs.Quality())

    monkeypatch.setattr(search, "reference_error", lambda *_: 0.0)
    plain = measured()
    monkeypatch.setattr(search, "reference_error", lambda *_: 0.25)
    assert measured() == plain + 0.25


def test_errors_are_measured_before_the_sensor(renderer, held_out):
    scene, _ = held_out[0]
    plain, dark = (within(renderer, scene, 1e-3, sensor=fs.Sensor(exposure=e)) for e in (1.0, 1e-3))
    assert dark.error == plain.error


def test_a_measured_quality_is_faster_than_a_promised_one(renderer, held_out):
    """Most scenes need less than the hardest one."""
    cutoff = fs.quality_within(error=1e-3, device=renderer).alpha_cutoff
    own = [within(renderer, scene, 1e-3).quality.alpha_cutoff for scene, _ in held_out[:6]]
    assert np.median(own) > cutoff


def test_choices_are_cached_and_a_damaged_file_is_replaced(renderer, scene, monkeypatch):
    first = within(renderer, scene, 1e-3)
    (file,) = quality_within.cache_folder().iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(search.SceneMeasurement, "error", lambda *_: pytest.fail("it was measured again"))
        again = within(renderer, scene, 1e-3)
    assert dataclasses.replace(again, source="measured") == first
    for broken in (
        b"",
        b"{",
        b"[1]",
        b'{"settings": {"alpha_cutoff": 7}, "error": 0, "ms": 0, "ms_p90": 0}',
    ):
        file.write_bytes(broken)
        assert within(renderer, scene, 1e-3).source == "measured"
        assert json.loads(file.read_bytes())["settings"]


def test_cache_keys_differ_by_question(renderer, scene):
    within(renderer, scene, 1e-3)
    within(renderer, scene, 1e-2)
    within(renderer, scene, 1e-3, quality="reference")
    within(renderer, scene, 1e-3, background=(0.2, 0.2, 0.2))
    within(renderer, random_scene(HELD_OUT + 2), 1e-3)
    moved = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, cx=scene.camera.cx + 1))
    within(renderer, moved, 1e-3)
    assert len(list(quality_within.cache_folder().iterdir())) == 6


def test_a_cache_folder_that_cannot_be_written_is_ignored(renderer, scene, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(quality_within, "cache_folder", lambda: tmp_path / "file" / "cache")
    assert within(renderer, scene, 1e-2).source == "measured"


def test_functions_have_no_key():
    assert _key(1, lambda: 2) is None
    assert _key(1, (2.0, None)) != _key(1, (2.0, 0))


def test_a_scene_has_its_own_capture(renderer, held_out):
    scene, want = held_out[3]
    rest = {"camera": scene.camera, "background": scene.background, "quality": fs.Quality(first_hit=0.2)}
    whole = fs.Scene([scene.cloud], **rest)
    quality = fs.quality_within(error=1e-3, scene=whole, device=renderer)
    assert quality.first_hit == 0.2
    assert errors(renderer.render(whole, quality=quality)["rgb"], want).maximum <= 1e-3


def test_a_device_without_a_setting(renderer, held_out, monkeypatch):
    """A device that projects in float64 only."""
    draw = fs.Renderer.render

    def lacking(self, cloud, capture=None, outputs=None, quality=None, **more):
        if fs.Quality.of(quality).projection_precision == "float32":
            raise fs.DeviceError("no projection in float32")
        return draw(self, cloud, capture, outputs, quality, **more)

    monkeypatch.setattr(fs.Renderer, "render", lacking)
    scene, want = held_out[2]
    for choice in (choose(3e-3, device=renderer), within(renderer, scene, 3e-3)):
        assert error_of(renderer, scene, choice.quality, want) <= 3e-3
        assert (choice.quality.projection_precision, choice.quality.arithmetic) == ("float64", "fast")
    with pytest.raises(InputError, match="error must be at least"):
        within(renderer, scene, 1e-12)


# times, with a simulated clock


@pytest.fixture
def clock(monkeypatch):
    """A frame takes ten milliseconds per decade of the cut-off."""

    def timer(self, quality):
        clock = Clock()

        def frame():
            clock.seconds -= 0.01 * float(np.log10(quality.alpha_cutoff))

        return Timer(frame, clock)

    monkeypatch.setattr(search.SceneMeasurement, "timer", timer)


def test_the_most_accurate_in_time(renderer, scene, clock):
    choice = within(renderer, scene, ms=31)
    cutoffs = {s.quality(fs.Quality()).alpha_cutoff for s in candidates.load(renderer.device.kind)}
    assert choice.quality.alpha_cutoff == min(cutoff for cutoff in cutoffs if -10 * np.log10(cutoff) <= 31)
    assert (choice.ms, choice.ms_p90) == pytest.approx((-10 * np.log10(choice.quality.alpha_cutoff),) * 2)
    assert within(renderer, scene, ms=45).error < choice.error


def test_error_and_time_together(renderer, scene, clock):
    choice = within(renderer, scene, 1e-2, 100)
    assert choice.error <= 1e-2
    with pytest.raises(
        InputError, match=r"ms must be at least .* for an error of 0.0001, got .*; the lowest error in that"
    ):
        within(renderer, scene, 1e-4, 25)


def test_nine_frames_of_ten_keep_a_time():
    """A candidate whose median is in time but not its 90th percentile is rejected."""
    late = {1e-2: 2.0, 1e-4: 9.0}

    class Known:
        base, renderer = fs.Quality(), SimpleNamespace(device=SimpleNamespace(name="known"))

        def error(self, quality):
            return quality.alpha_cutoff

        def time(self, quality):
            return 1.0

        def times(self, qualities, repeats=9):
            return [search.Times(1.0, late[quality.alpha_cutoff]) for quality in qualities]

    front = tuple(candidates.Candidate({"alpha_cutoff": cutoff}, 0, 0, 0, 1.0) for cutoff in late)
    known = search.CandidateSearch(Known(), front)
    assert known.most_accurate_in(5.0).error == 1e-2
    assert known.most_accurate_in(10.0).error == 1e-4
    measured = import_module("fidsplat.accuracy.quality_within")._search
    assert measured(known, 1e-3, 10.0).error == 1e-4
    with pytest.raises(
        InputError, match=r"ms must be at least 9 on known .*, got 5; the lowest error .* 0\.01"
    ):
        measured(known, 1e-3, 5.0)


def test_late_frames_are_the_90th_percentile_without_the_first(renderer, scene, monkeypatch):
    """Frames of 1 to 9 ms after one of a second, which warms up."""
    calibration = search.SceneMeasurement.__new__(search.SceneMeasurement)
    times = iter([1.0, *(ms / 1e3 for ms in (5, 3, 9, 1, 7, 2, 8, 4, 6))])
    clock = Clock()

    def frame():
        clock.seconds += next(times)

    monkeypatch.setattr(calibration, "_report", lambda words: None, raising=False)
    monkeypatch.setattr(calibration, "timer", lambda quality: Timer(frame, clock), raising=False)
    assert calibration.times([fs.Quality()], repeats=9) == [
        search.Times(pytest.approx(5.0), pytest.approx(8.2))
    ]


@pytest.mark.parametrize("ms", [0, -3, 1e-6])
def test_an_impossible_time(renderer, scene, clock, ms):
    with pytest.raises(InputError, match=r"ms must be at least [\d.]+ .* quality has an error of"):
        within(renderer, scene, ms=ms)


def test_frames_are_timed(renderer, scene):
    choice = within(renderer, scene, ms=10_000)
    assert 0 < choice.ms <= choice.ms_p90 <= 10_000
    assert choice.error < 1e-4


# invalid requests


@pytest.mark.parametrize("error", [0, -1e-3, 1e-9])
def test_an_impossible_error(renderer, scene, error):
    with pytest.raises(InputError, match=r"error must be at least \d.*, the lowest bound"):
        fs.quality_within(error=error, device=renderer)
    with pytest.raises(InputError, match=r"error must be at least \d.*allow \d"):
        within(renderer, scene, error)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({}, "must have a bound"),
        ({"error": float("nan")}, "error must be .* got nan"),
        ({"error": "small"}, "error must be .* got 'small'"),
        ({"error": True}, "error must be .* got True"),
        ({"ms": float("inf")}, "ms must be .* got inf"),
        ({"ms": 5}, "scene must be given with"),
        ({"error": 1e-3, "scene": fs.SplatCloud.empty()}, "camera must be given with"),
        ({"error": 1e-3, "capture": fs.Camera.pinhole(2, 2, 1.0, 1.0, 1.0, 1.0)}, "scene must be given with"),
        (
            {"error": 1e-3, "scene": 7, "capture": fs.Camera.pinhole(2, 2, 1.0, 1.0, 1.0, 1.0)},
            "scene must be .* got a int",
        ),
        ({"error": 1e-3, "capture": "best"}, "camera must .* got 'best'"),
    ],
)
def test_invalid_bounds(words, message):
    with pytest.raises(InputError, match=message):
        fs.quality_within(**words)
