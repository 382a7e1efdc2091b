"""Group D: opacity, transmittance, depth outputs."""

import pytest
from cases import assert_holds

from fidsplat.hard_cases import group_d


@pytest.mark.parametrize("case", group_d.CASES, ids=lambda case: case.name)
def test_case(renderer, case):
    assert_holds(renderer, case)


def test_every_entry_of_the_catalogue_is_there():
    assert [case.name for case in group_d.CASES] == ["D1", "D2", "D3", "D4", "D5"]
