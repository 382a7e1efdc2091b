"""All cases of the self-test (devlog/hard-cases.md) on every device."""

import pytest
from agreement import reference_images

from fidsplat.selftest import check
from fidsplat.selftest.catalogue import GROUPS, all_cases
from fidsplat.selftest.intersection import QUALITY, grazing_errors

SIZES = {"A": 7, "B": 8, "C": 4, "D": 5, "E": 5, "F": 6, "G": 5}


@pytest.mark.parametrize("case", all_cases(), ids=lambda case: case.name)
def test_case(renderer, case, monkeypatch):
    """All frames agree with the reference, and all findings hold. Each case is on one device in a run."""
    monkeypatch.setattr(check, "reference_images", reference_images)  # each rendered once for all devices
    result, _ = check.run_case(renderer, case)
    assert result.wrong == []


def test_the_catalogue_is_complete():
    """A1 to G5, each once."""
    cases = all_cases()
    names = [f"{letter}{n}" for letter, count in SIZES.items() for n in range(1, count + 1)]
    assert [case.name for case in cases] == names
    assert [case.name for case in all_cases("CA")] == [name for name in names if name[0] in "AC"]
    assert list(GROUPS) == list(SIZES)
    assert all(case.title and case.trigger for case in cases)


def test_case_b1_detects_a_float32_setup(renderer):
    """Errors are more than ten times larger."""
    single = QUALITY.with_(projection_precision="float32")
    error = grazing_errors(renderer, 85.0, 3, single).max()
    assert error > 1e-4
    if renderer.device.float64:
        assert grazing_errors(renderer, 85.0, 3).max() < error / 10
