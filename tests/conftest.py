"""Every device that can be opened here, the reference excepted: contract tests run on each."""

import pytest

import fidsplat as fs

USABLE = [info for info in fs.devices() if info.usable and info.name != "reference"]


@pytest.fixture(scope="session", params=[info.name for info in USABLE])
def renderer(request):
    return fs.Renderer(request.param)


@pytest.fixture(scope="session")
def judge():
    return fs.Renderer("reference")
