"""Group A: bounds, the near plane, what lies behind the camera."""

import pytest
from cases import assert_holds

from fidsplat.hard_cases import group_a


@pytest.mark.parametrize("case", group_a.CASES, ids=lambda case: case.name)
def test_case(renderer, case):
    assert_holds(renderer, case)


def test_every_entry_of_the_catalogue_is_there():
    assert [case.name for case in group_a.CASES] == [f"A{n}" for n in range(1, 7 + 1)]
