"""Compile matrix on Warp: single effects, all, and pairs, against the reference.

Warp compiles a stage in seconds, so plain pytest runs a sample; `pytest -m exhaustive` runs the rest."""

from itertools import combinations

import pytest
from combined import LENSES, SWITCHES, all_effects, assert_renders, combination, is_compatible
from sampling import sampled

from fidsplat.backends.warp.program import unsupported

BACKEND = "warp"


def has(name):
    """Whether the Warp kernels have the effect."""
    return not unsupported(combination([name]).features(), "warp")


OWN = [name for name in SWITCHES if has(name)]
PAIRS = [pair for pair in combinations(OWN, 2) if is_compatible(pair)]


def test_warp_has_all_effects():
    assert set(SWITCHES) == set(OWN)


@pytest.mark.parametrize("name", sampled(OWN, 3, 12))
def test_each_single_effect(renderer, name):
    assert_renders(renderer, (name,))


# other combinations are in test_combinations.py and test_gpu_schedule.py of tests/contract
@pytest.mark.parametrize("lens", sampled([None, *LENSES], 3, 2))
def test_all_effects(renderer, lens):
    assert_renders(renderer, [name for name in all_effects(lens) if has(name)])


@pytest.mark.parametrize("pair", sampled(PAIRS, 3, 12), ids=" and ".join)
def test_pairs(renderer, pair):
    assert_renders(renderer, pair)
