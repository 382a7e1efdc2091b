"""Frame and stage times of each scene; splats and images stay on the device."""

import pytest
from conftest import CLOCK


def render(run):
    """Render one frame and wait for it."""
    return run.render().wait()


def facts(benchmark, run) -> None:
    benchmark.extra_info |= {"width": run.camera.width, "height": run.camera.height, **run.result.counts}


@pytest.mark.benchmark(group="frame")
def test_frame(benchmark, run):
    facts(benchmark, run)
    benchmark.pedantic(render, (run,), rounds=10, warmup_rounds=2)


@pytest.mark.benchmark(group="stage", timer=CLOCK)
def test_stage(benchmark, run, stage):
    def one():
        CLOCK.seconds += 1e-3 * render(run).timings[stage]

    facts(benchmark, run)
    benchmark.pedantic(one, rounds=10, warmup_rounds=2)
