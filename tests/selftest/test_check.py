"""`fidsplat check`: reports of correct and of faulty devices."""

import json
from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import read_image
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest import catalogue, check, inputs
from fidsplat.selftest.agreement import ALL_OUTPUTS, FrameSpec
from fidsplat.selftest.arithmetic import BOUNDS, measure
from fidsplat.selftest.case import Case, Finding
from fidsplat.selftest.clouds import camera, rotation, splats
from fidsplat.util.errors import DeviceError

CLOUD = random_splats(40, seed=41, depth=(1.0, 4.0), scale=(0.02, 0.5))


def specs():
    yield FrameSpec(CLOUD, camera(40, 30, 40.0), outputs=("rgb", "alpha", "depth"))


def good(renderer):
    yield from specs()
    yield Finding("a number", 1.0, 1.0)


GOOD = Case("A1", "a good case", "nothing", good)


class Broken:
    """A renderer with faulty images."""

    def __init__(self, renderer, spoil):
        self.device, self.backend, self._renderer, self._spoil = (
            renderer.device,
            renderer.backend,
            renderer,
            spoil,
        )

    def render(self, *arguments, **named):
        frame = self._renderer.render(*arguments, **named)
        return {name: self._spoil(name, frame[name].copy()) for name in frame}


def test_a_good_device_passes(renderer):
    messages = []
    result = check.run_check(renderer, [GOOD], messages.append)
    assert result.passed
    assert result.failures == []
    assert messages == ["arithmetic", "A1: a good case"]
    (only,) = result.groups["A"]
    assert (only.frames, only.passed) == (1, True)
    assert set(only.largest) == set(only.beyond_bound) == {"rgb", "alpha", "depth"}
    assert only.beyond_bound["rgb"] <= 2e-5
    assert result.worst is not None
    image = check.worst_image(result.worst)
    assert image.dtype == np.uint8
    assert image.shape[1] > 800


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda name, plane: plane + (name == "alpha") * np.float32(1e-4), "alpha has an error of"),
        (lambda name, plane: plane * np.float32(1 + (name == "depth") * 1e-2), "depth has an error of"),
        (lambda name, plane: np.where(plane > 9, plane, np.nan), "not finite"),
    ],
)
def test_a_bad_device_fails(renderer, spoil, words):
    result = check.run_check(Broken(renderer, spoil), [GOOD])
    assert not result.passed
    assert any(words in failure for failure in result.failures), result.failures
    assert result.worst is not None
    assert result.worst.rank[0]
    sheet = check.worst_image(result.worst)
    other = check.worst_image(replace(result.worst, rank=(False, 0.0)))
    assert (sheet[:52] != other[:52]).any(), "the caption says whether it fails"
    np.testing.assert_array_equal(sheet[56:], other[56:])


def test_findings_that_do_not_hold(renderer):
    bad = Case("B2", "bad", "", lambda _: [Finding("jump", np.nan, 1.0), Finding("slip", 2.0, 1.0)])
    result = check.run_check(renderer, [GOOD, bad])
    assert result.failures == ["B2: jump is nan, above 1", "B2: slip is 2, above 1"]
    assert [(letter, one.passed) for letter, (one,) in result.groups.items()] == [("A", True), ("B", False)]


def test_a_device_that_fails_fails_its_case_only(renderer):
    def fails(_):
        raise DeviceError("out of memory")
        yield

    result = check.run_check(renderer, [Case("A2", "fails", "", fails), GOOD])
    assert result.failures == ["A2: out of memory"]
    assert result.cases[1].passed


def test_error_bounds_are_small_where_nothing_is_hard():
    """In an ordinary scene error bounds are below the tolerance in every pixel, and nothing may flip."""
    cloud = random_splats(300, seed=20, depth=(1.0, 6.0), scale=(0.01, 0.3))
    expected = check.reference_images(FrameSpec(cloud, camera(), outputs=ALL_OUTPUTS))
    assert expected["alpha"].max() > 0.9
    assert expected["error_bound"].max() < 1e-5
    assert np.median(expected["error_bound"]) < 2e-6
    # but where 1/255 is covered, the rim of every output but colour: a decision, which has its error bound
    rim = np.abs(expected["alpha"] - 1 / 255) < 6e-5
    assert rim.mean() < 1e-3
    assert not expected["label_may_flip"][~rim].any()
    # and where a fragment takes 1/255 of the light, no more or less, which the median asks
    assert expected["depth_median_may_flip"].mean() < 5e-4


def test_error_bounds_cover_decisions_within_float32_rounding():
    # a needle 1e-4 px wide across the image, through pixel centres; a splat at the cut-off; a tie
    needle = splats([[0.00625, 0.00625, 1]], rotation((0, 0, 1), 45), (0.4, 1.25e-6))
    faint = splats([[0.00625, 0.00625, 1]], (1, 0, 0, 0), 0.2, np.float32(1 / 255) * (1 + 1e-6))
    tie = splats([[0, 0, 1], [0, 0, 2]], (1, 0, 0, 0), 50.0, [0.5, 1.0], labels=[1, 2])
    truths = [
        check.reference_images(FrameSpec(cloud, camera(), outputs=ALL_OUTPUTS))
        for cloud in (needle, faint, tie)
    ]
    assert truths[0]["error_bound"].max() > 1e-3
    assert 0.003 < truths[1]["error_bound"].max() < 0.005
    assert truths[2]["label_may_flip"].any()
    assert all(expected["error_bound"][0, 0] < 1e-5 for expected in truths)


def test_too_many_uncertain_pixels_fail(renderer, monkeypatch):
    reference_images = check.reference_images

    def uncertain(spec):
        expected = reference_images(spec)
        return expected | {"error_bound": expected["error_bound"] + 0.06}

    monkeypatch.setattr(check, "reference_images", uncertain)
    failures = check.run_check(renderer, [GOOD]).failures
    assert "error bounds above 0.05" in failures[0]


def test_arithmetic(renderer, reference):
    facts = measure(renderer)
    assert set(BOUNDS) <= set(facts.ulp) or not facts.float64
    assert all(finding.holds for finding in facts.findings), facts.findings
    assert facts.ulp["division"] > 0.3  # it does measure
    assert measure(reference) is None


def test_the_reference_agrees_with_itself(reference):
    assert check.run_check(reference, catalogue.all_cases("A")[:2]).passed


@pytest.mark.parametrize("found", [inputs.e2, inputs.e4])
def test_the_reference_passes_its_own_cases(found, reference):
    findings = [each for each in found(reference) if isinstance(each, Finding)]
    assert findings
    assert all(each.holds for each in findings), findings


def test_the_command(renderer, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(catalogue, "all_cases", lambda: (GOOD,))
    words = ["check", "--device", renderer.device.name, "--out", str(tmp_path / "here")]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "all checks passed" in out
    assert "A bounds" in out
    assert "exp" in out
    assert read_image(tmp_path / "here" / "worst.png").shape[2] == 3
    assert main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["passed"] is True
    assert facts["cases"][0]["name"] == "A1"
    assert facts["arithmetic"]["ulp"]["exp"] <= 3
    assert facts["picture"].endswith("worst.png")


def test_the_command_fails_with_the_device(renderer, tmp_path, capsys, monkeypatch):
    bad = Case("C1", "bad", "", lambda _: [Finding("slip", 2.0, 1.0)])
    monkeypatch.setattr(catalogue, "all_cases", lambda: (bad,))
    assert main(["check", "--device", renderer.device.name, "-o", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "failed: C1: slip is 2, above 1" in out
    assert "1 check failed" in out
    assert not (tmp_path / "worst.png").exists()


def test_the_command_fuzzes(renderer, tmp_path, capsys):
    words = ["check", "--device", renderer.device.name, "-o", str(tmp_path), "--fuzz", "300"]
    assert main(words) == 0
    assert "failing seeds: none" in capsys.readouterr().out
    assert main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["splats"] >= 300
    assert (tmp_path / "fuzz.json").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [(["--fuzz", "0"], "--fuzz must be at least 1 splat, got 0"), (["--device", "opncl"], "'opencl'")],
)
def test_bad_words(words, says, tmp_path, capsys):
    assert main(["check", "-o", str(tmp_path), *words]) == 2
    assert says in capsys.readouterr().err


def test_the_result_is_plain_data(renderer):
    facts = check.run_check(renderer, [GOOD]).as_dict()
    assert fs.Renderer(facts["device"]).device.title == facts["title"]
    json.dumps(facts)
