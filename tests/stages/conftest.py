"""Devices whose stages can be looked at."""

import pytest


@pytest.fixture(scope="module")
def backend(renderer):
    if not renderer.backend.traits.probed:
        pytest.skip("draws in one piece")
    return renderer.backend
