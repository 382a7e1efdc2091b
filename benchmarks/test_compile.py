"""Compilation time of the first frame in a new process, with empty and with filled caches."""

import itertools

import pytest
from conftest import CLOCK
from first_frame import SCENES, first_frame


@pytest.mark.benchmark(group="first frame", timer=CLOCK)
@pytest.mark.parametrize("caches", ["cold", "warm"])
@pytest.mark.parametrize("scene", SCENES)
def test_first_frame(benchmark, device, tmp_path, scene, caches):
    folders = itertools.count()
    parts = {}

    def one():
        folder = tmp_path / (str(next(folders)) if caches == "cold" else "kept")
        parts.update(first_frame(scene, device, folder))
        CLOCK.seconds += parts["frame"]

    benchmark.pedantic(one, rounds=3, warmup_rounds=1 if caches == "warm" else 0)
    benchmark.extra_info |= {f"{part}_seconds": seconds for part, seconds in parts.items()}
