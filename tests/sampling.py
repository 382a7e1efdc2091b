"""Sweeps of which plain pytest takes a sample, and `pytest -m exhaustive` the rest."""

from collections.abc import Sequence

import numpy as np
import pytest


def sampled(cases: Sequence, count: int, seed: int) -> list:
    """All cases as parameters; all but `count` of them, chosen by chance, are marked `exhaustive`."""
    kept = set(np.random.default_rng(seed).choice(len(cases), min(count, len(cases)), replace=False).tolist())
    rest = pytest.mark.exhaustive
    return [pytest.param(case, marks=() if k in kept else rest) for k, case in enumerate(cases)]
