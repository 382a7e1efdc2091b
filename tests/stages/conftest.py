"""Devices with access to the buffers between stages."""

import pytest


@pytest.fixture(scope="module")
def backend(renderer):
    if not renderer.backend.has("probe"):
        pytest.skip("has no separate stages")
    return renderer.backend
