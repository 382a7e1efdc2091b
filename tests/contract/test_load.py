"""Threads and processes: the short form of tools/load.py."""

from concurrent.futures import ThreadPoolExecutor

import load
import pytest

import fidsplat as fs


@pytest.mark.sweep
@pytest.mark.parametrize("device", ["opencl", "warp:cpu"])
def test_threads_share_a_renderer_or_have_their_own(device):
    seeds = range(6)
    expected = [load.digest_of_views(fs.Renderer(device), seed) for seed in seeds]
    shared = fs.Renderer(device)
    with ThreadPoolExecutor(len(seeds)) as pool:
        assert list(pool.map(lambda seed: load.digest_of_views(shared, seed), seeds)) == expected
        assert list(pool.map(lambda seed: load.digest_of_views(fs.Renderer(device), seed), seeds)) == expected


@pytest.mark.sweep
def test_processes_share_an_empty_kernel_cache(monkeypatch):
    monkeypatch.setattr(load, "PROCESSES", 3)
    assert load.processes("opencl") == {"wrong of 3 processes": 0}


def test_temporary_memory_is_not_growth():
    each = [(10.0 * k, 500 + 100 * (k % 3 == 0) + k // 100) for k in range(720)]
    assert load.levels(each, 7200) == (501, 507)
    assert load.levels([(1.0, 7)], 60) == (7, 7)
