"""Runs a hard case on a device."""

from fidsplat.hard_cases.agreement import judge
from fidsplat.hard_cases.case import Case
from fidsplat.render import Renderer


def assert_holds(renderer: Renderer, case: Case) -> None:
    """All pictures of a case agree with the reference, and all its findings hold."""
    for number, picture in enumerate(case.pictures() if case.pictures else ()):
        for difference in judge(renderer, picture):
            assert difference.agrees, f"{case.name}, picture {number}: {difference}"
    for finding in case.check(renderer) if case.check else ():
        assert finding.holds, f"{case.name}: {finding}"
