"""The compile matrix on Warp: effects alone, all that it has, and pairs, against the reference.

Warp compiles a stage for seconds, so plain pytest takes a sample; with FIDSPLAT_ALL_PAIRS=1 in the
environment it takes each effect and all pairs."""

import os
from itertools import combinations

import numpy as np
import pytest
from combined import LENSES, SWITCHES, assert_drawn, combination, everything, goes

from fidsplat.backends.warp.program import unsupported

BACKEND = "warp"


def has(name):
    """Whether the Warp kernels have the effect."""
    return not unsupported(combination([name]).features(), "warp")


OWN = [name for name in SWITCHES if has(name)]
PAIRS = [pair for pair in combinations(OWN, 2) if goes(pair)]
WHOLE = bool(os.environ.get("FIDSPLAT_ALL_PAIRS"))


def some(names, count):
    """As many of them by chance, or all."""
    if WHOLE:
        return names
    return [names[k] for k in np.random.default_rng(12).choice(len(names), count, replace=False)]


def test_warp_has_all_effects():
    assert set(SWITCHES) == set(OWN)


@pytest.mark.parametrize("name", some(OWN, 3))
def test_each_effect_alone(renderer, name):
    assert_drawn(renderer, (name,))


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_all_effects(renderer, lens):
    assert_drawn(renderer, [name for name in everything(lens) if has(name)])


@pytest.mark.parametrize("pair", some(PAIRS, 4), ids=" and ".join)
def test_pairs(renderer, pair):
    assert_drawn(renderer, pair)
