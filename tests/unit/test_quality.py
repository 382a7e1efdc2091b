"""Quality settings: ranges, combinations and sources."""

import json
from importlib.resources import files

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.capture.quality import TEMPLATE_SIZES
from fidsplat.markers.mixture import fitted_templates

TEMPLATES = files("fidsplat.markers").joinpath("templates.json")
WRONG = {
    "arithmetic": "quick",
    "blend_precision": "float8",
    "samples": 9,
    "marker": "paper",
}
WRONG_OF_MARKERS = {"mixture": "best", "levels": 9, "density": 0, "growth": 1.5, "template": 4}


@pytest.mark.parametrize("name", WRONG)
def test_a_value_out_of_range_is_named_with_what_would_do(name):
    with pytest.raises(fs.InputError, match=f"{name} (is|must) .*"):
        fs.Quality(**{name: WRONG[name]})


@pytest.mark.parametrize("name", WRONG_OF_MARKERS)
def test_so_is_a_setting_of_markers(name):
    with pytest.raises(fs.InputError, match=f"{name} (is|must) .*"):
        fs.MarkerQuality(**{name: WRONG_OF_MARKERS[name]})


@pytest.mark.parametrize("value", [True, 2.0, "2", None])
def test_samples_are_whole_numbers(value):
    with pytest.raises(fs.InputError, match="samples"):
        fs.Quality(samples=value)


def test_blending_in_float64_refuses_what_would_undo_it():
    with pytest.raises(fs.InputError, match="blend_precision='float64'"):
        fs.Quality(blend_precision="float64", projection_precision="float32")


@pytest.mark.parametrize(
    ("text", "quality"),
    [
        ("fast", fs.Quality.named("fast")),
        ("alpha_cutoff=1e-3", fs.Quality(alpha_cutoff=1e-3)),
        (" fast , samples = 2 ", fs.Quality.named("fast").with_(samples=2)),
        ("samples=3,marker.growth=none", fs.Quality(samples=3)),
        (
            "standard,marker.mixture=paper,marker.growth=0.1",
            fs.Quality(marker=fs.MarkerQuality("paper", growth=0.1)),
        ),
    ],
)
def test_text_says_a_quality(text, quality):
    assert fs.Quality.of(text) == quality


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("fats", "did you mean 'fast'"),
        ("fast,samples", "key=value"),
        ("fast,samples=two", "whole number"),
        ("alpha_cutoff=", "must be a number"),
        ("alpha_cutof=1", "did you mean 'alpha_cutoff'"),
        ("marker.templat=9", "did you mean 'template'"),
        ("marker=paper", "marker.template=9"),
        ("arithmetic=quick", "precise, fast"),
        ("", "standard"),
    ],
)
def test_text_that_says_none(text, says):
    with pytest.raises(fs.InputError, match=says):
        fs.Quality.of(text)


def test_shipped_templates_are_those_that_quality_knows():
    for size in TEMPLATE_SIZES:
        square = fitted_templates(size)[0].gaussians
        assert len(square) == size
    fitted = {size: fs.marker("apriltag:36h11:5", mixture="fitted", template=size) for size in TEMPLATE_SIZES}
    counts = [len(one.cloud) for one in fitted.values()]
    assert counts == sorted(counts)
    assert len(fitted[1].cloud) == len(fitted[1].boxes)


def test_larger_templates_are_better_ones():
    reached = [entry["fit_db"] for entry in json.loads(TEMPLATES.read_text("utf-8"))["sets"]]
    assert reached == sorted(reached)


def test_a_marker_takes_from_a_quality_what_it_does_not_say():
    quality = fs.MarkerQuality("paper", levels=2, density=1, template=9, growth=0.2)
    by_quality = fs.marker("apriltag:36h11:5", quality=quality)
    by_itself = fs.marker("apriltag:36h11:5", mixture="paper", levels=2, density=1, growth=0.2)
    assert np.array_equal(by_quality.cloud.scales, by_itself.cloud.scales)
    assert fs.marker("apriltag:36h11:5", mixture="fitted", quality=quality).quality.template == 9
    # what does not concern the mixture is let be; what is requested is not
    assert fs.marker("apriltag:36h11:5", mixture="exact", quality=quality).mixture == "exact"
    with pytest.raises(
        fs.InputError, match="template must be given with mixture exact or fitted, got paper; leave it"
    ):
        fs.marker("apriltag:36h11:5", mixture="paper", template=9)
    with pytest.raises(fs.InputError, match="MarkerQuality"):
        fs.marker("apriltag:36h11:5", quality=fs.Quality())  # type: ignore[arg-type]


def test_numbers_of_numpy_are_numbers_and_truth_values_are_not():
    quality = fs.Quality(alpha_cutoff=np.float32(0.25), samples=np.int64(2), first_hit=np.float64(0.5))
    assert quality == fs.Quality(alpha_cutoff=0.25, samples=2, first_hit=0.5)
    assert {type(quality.alpha_cutoff), type(quality.samples)} == {float, int}
    for name in ("samples", "opacity_ceiling"):
        with pytest.raises(fs.InputError, match=f"{name} .*True"):
            fs.Quality(**{name: True})
