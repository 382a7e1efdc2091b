"""Every device that can be opened here, the reference excepted: contract tests run on each."""

import math
import random
import signal

import hypothesis
import pytest
import sampling
from rich.progress import Progress

import fidsplat as fs

pytest_plugins = ["error_bounds", "optimisation"]
# other processes make an example slow, not the code
hypothesis.settings.register_profile("tests", deadline=None)
hypothesis.settings.load_profile("tests")

USABLE = [info for info in fs.devices() if info.usable and info.name != "reference"]


def pytest_generate_tests(metafunc):
    """A module may name the one BACKEND that has the effects that it is about."""
    # some modules have a fixture of their own
    if "renderer" in metafunc.fixturenames and not hasattr(metafunc.module, "renderer"):
        backend = getattr(metafunc.module, "BACKEND", "")
        names = [info.name for info in USABLE if info.name.startswith(backend)]
        metafunc.parametrize("renderer", names, indirect=True, scope="session")


def pytest_addoption(parser):
    words = "sample of devices, pixels and cases (tests/sampling.py), 0 to 7; each run draws one"
    parser.addoption("--turn", type=int, help=words)


def pytest_configure(config):
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as shells start processes in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config, "workerinput"):
        config.option.turn = config.workerinput["turn"]
    elif config.option.turn is None:
        config.option.turn = random.randrange(8)
    if config.option.markexpr == "not exhaustive":
        sampling.TURN = config.option.turn


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node):
    """Workers of xdist run the sample of the process that starts them."""
    node.workerinput["turn"] = node.config.option.turn


def pytest_report_header(config):
    return f"devices, pixels and cases in turn: this sample by --turn={config.option.turn}"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    sampling.take_turns(items, [info.name for info in USABLE if info.kind == "cpu"], config.option.turn)


@pytest.fixture(scope="session")
def renderer(request):
    return fs.Renderer(request.param)


@pytest.fixture(scope="session")
def reference():
    return fs.Renderer("reference")


@pytest.fixture(autouse=True)
def progress_within_its_total(monkeypatch):
    """Progress bars of commands stay between nothing and all."""
    outside, update = [], Progress.update

    def checked(bar, task_id, **changes):
        update(bar, task_id, **changes)
        task = bar._tasks[task_id]
        if not 0 <= task.completed <= (math.inf if task.total is None else task.total * (1 + 1e-9)):
            outside.append((task.description, task.completed, task.total))

    monkeypatch.setattr(Progress, "update", checked)
    yield
    assert not outside
