"""Group F: the device's own arithmetic."""

import pytest
from cases import assert_holds

from fidsplat.hard_cases import group_f


@pytest.mark.parametrize("case", group_f.CASES, ids=lambda case: case.name)
def test_case(renderer, case):
    assert_holds(renderer, case)


def test_every_entry_of_the_catalogue_is_there():
    assert [case.name for case in group_f.CASES] == ["F1", "F2", "F3", "F4", "F5", "F6"]
