"""Devices whose stages can be looked at."""

import pytest

from fidsplat.backends.probing import Reshapes


@pytest.fixture(scope="module")
def backend(renderer):
    if not isinstance(renderer.backend, Reshapes):
        pytest.skip("draws in one piece")
    return renderer.backend
