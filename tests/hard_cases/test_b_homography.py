"""Group B: the arithmetic of the ray's meeting with a splat."""

import pytest
from cases import assert_holds

from fidsplat.hard_cases import group_b
from fidsplat.hard_cases.homography import QUALITY, grazing_errors


@pytest.mark.parametrize("case", group_b.CASES, ids=lambda case: case.name)
def test_case(renderer, case):
    assert_holds(renderer, case)


def test_every_entry_of_the_catalogue_is_there():
    assert [case.name for case in group_b.CASES] == [f"B{n}" for n in range(1, 8 + 1)]


def test_float32_setup_shows_why_float64_is_used(renderer):
    """The measure of B1 does see a set-up in single precision: ten times and more (numerics B1, table)."""
    single = QUALITY.with_(setup_precision="float32")
    error = grazing_errors(renderer, 85.0, 3, single).max()
    assert error > 1e-4
    if renderer.device.float64:
        assert grazing_errors(renderer, 85.0, 3).max() < error / 10
