"""Benchmark suite: `pytest benchmarks/`. `--device D` selects a device, `--big` adds scenes that small
machines skip, and `--benchmark-json FILE` writes the figures with facts of the device.
"""

from __future__ import annotations

from dataclasses import asdict

import pytest

import fidsplat as fs
from fidsplat.experiments.bench.catalogue import BENCH_SCENES
from fidsplat.experiments.bench.measure import SceneRun
from fidsplat.util.timing import Clock

try:
    import pytest_benchmark  # noqa: F401  the fixture `benchmark`
except ImportError:
    pytest.exit("these benchmarks need pytest-benchmark: pip install '.[bench]'", returncode=4)

HEAVY = ("r5m_1080p", "r5m_1080p_3d", "r20m_4k", "qr_wall")
SMALL_MACHINE = 8
"""Compute units of a processor below which large scenes are skipped."""


CLOCK = Clock()
"""advanced by the measured time: of a stage by the device's clock, or of a part of a child process"""


def pytest_addoption(parser) -> None:
    parser.addoption("--device", default="opencl", help="where the benchmarks draw")
    parser.addoption("--big", action="store_true", help="draw heavy scenes on a small machine too")


def pytest_benchmark_update_machine_info(config, machine_info) -> None:
    renderer = fs.Renderer(config.getoption("--device"))
    backend = renderer.backend
    rates = backend.rates() if backend.has("rates") else None
    machine_info["fidsplat"] = {
        "version": fs.__version__,
        "device": asdict(renderer.device),
        "rates": rates and asdict(rates),
    }


def pytest_generate_tests(metafunc) -> None:
    if "stage" in metafunc.fixturenames:
        frame = fs.Renderer(metafunc.config.getoption("--device")).render(*BENCH_SCENES["tag"].make())
        metafunc.parametrize("stage", list(frame.timings))


@pytest.fixture(scope="session")
def device(pytestconfig) -> str:
    return pytestconfig.getoption("--device")


@pytest.fixture(scope="session", params=list(BENCH_SCENES))
def run(request, device) -> SceneRun:
    """A scene on the device after its first frame."""
    scene = BENCH_SCENES[request.param]
    info = fs.Renderer(device).device
    small = info.kind == "cpu" and info.compute_units < SMALL_MACHINE
    if request.param in HEAVY and small and not request.config.getoption("--big"):
        pytest.skip(f"{request.param} takes long on {info.compute_units} cores; --big renders it")
    made = SceneRun(request.param, device, None, *scene.make())
    assert not made.result.timer.error, made.result.timer.error
    return made
