"""The knobs: their ranges, what goes together, and where they come from."""

import pytest

import fidsplat as fs

WRONG = {
    "arithmetic": "quick",
    "blend_precision": "float16",
    "color_precision": "float64",
    "depth_key_bits": 20,
    "tile_size": 12,
    "marker": "paper",
}
WRONG_OF_MARKERS = {"mixture": "best", "levels": 9, "density": 0, "growth": 1.5, "template": 4}


@pytest.mark.parametrize("name", WRONG)
def test_a_value_out_of_range_is_named_with_what_would_do(name):
    with pytest.raises(fs.InputError, match=f"{name} is .*(known:|must)"):
        fs.Quality(**{name: WRONG[name]})


@pytest.mark.parametrize("name", WRONG_OF_MARKERS)
def test_so_is_a_knob_of_markers(name):
    with pytest.raises(fs.InputError, match=f"{name} is .*(known:|must)"):
        fs.MarkerQuality(**{name: WRONG_OF_MARKERS[name]})


@pytest.mark.parametrize("value", [True, 16.0, "16", None])
def test_key_bits_are_whole_numbers(value):
    with pytest.raises(fs.InputError, match="depth_key_bits"):
        fs.Quality(depth_key_bits=value)


@pytest.mark.parametrize("other", [{"setup_precision": "float32"}, {"arithmetic": "fast"}])
def test_blending_in_float64_refuses_what_would_undo_it(other):
    with pytest.raises(fs.InputError, match="blend_precision='float64'"):
        fs.Quality(blend_precision="float64", **other)
