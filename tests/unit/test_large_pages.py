"""Large pages: advice for memory that stays the device's own."""

import mmap
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pyopencl as cl
import pytest

import fidsplat as fs
from fidsplat.backends.opencl import buffers
from fidsplat.backends.opencl.buffers import large_pages


@pytest.mark.skipif(not hasattr(mmap, "MADV_HUGEPAGE"), reason="the system has no such advice")
def test_advice_leaves_contents_as_they_are():
    memory = np.arange(1 << 20, dtype=np.int64)
    large_pages(memory.ctypes.data, memory.nbytes)
    assert np.array_equal(memory, np.arange(1 << 20))
    assert not large_pages(memory.ctypes.data + 8, mmap.PAGESIZE)  # no whole page


def test_large_buffers_are_the_devices_own(monkeypatch):
    """Memory of the host's would be gone with the Python object, though a kernel still writes there."""
    requested = []
    monkeypatch.setattr(buffers, "large_pages", lambda address, size: requested.append((address, size)))
    pool = fs.Renderer("opencl:cpu").backend.pool
    small, large = pool.allocate("small", 1 << 12), pool.allocate("large", (1 << 22) + 20)
    for buffer in (small, large):
        assert not buffer.flags & cl.mem_flags.USE_HOST_PTR
    assert [size for _, size in requested] == [large.size]
    assert all(address > 0 for address, _ in requested)


@pytest.mark.skipif(sys.platform != "linux", reason="counts pages by /proc/self/smaps")
def test_a_large_buffer_uses_large_pages():
    with open("/sys/kernel/mm/transparent_hugepage/enabled", encoding="ascii") as file:
        if "[never]" in file.read():
            pytest.skip("the system gives no large pages")
    context = multiprocessing.get_context("spawn")  # memory that a process frees may be large pages already
    with ProcessPoolExecutor(1, mp_context=context) as fresh:
        assert fresh.submit(growth_in_large_pages, 64 << 20).result() > 32 << 20


def growth_in_large_pages(size):
    """Bytes in large pages that a new buffer of that size adds to the process."""
    backend = fs.Renderer("opencl:cpu").backend
    queue, before = cl.CommandQueue(backend.context), in_large_pages()
    buffer = backend.pool.allocate("large", size)
    cl.enqueue_fill_buffer(queue, buffer, np.zeros(1, np.uint32), 0, size).wait()
    return in_large_pages() - before


def in_large_pages():
    with open("/proc/self/smaps", encoding="ascii") as file:
        return sum(int(line.split()[1]) for line in file if line.startswith("AnonHugePages:")) << 10
