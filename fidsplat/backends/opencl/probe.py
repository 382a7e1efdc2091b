"""Access to an OpenCL device for tests: small kernels, single stages, and buffers filled with NaN."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.buffers import BufferPool
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.pipeline import OpenCLPipeline
from fidsplat.backends.opencl.program import compile_test_kernels
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.probing import Probe
from fidsplat.util.errors import DeviceError


def evaluate(
    workspace: Workspace, text: str, inputs: Sequence[np.ndarray], outputs: Sequence[np.dtype | type]
) -> list[np.ndarray]:
    """Compile `text` after prelude.cl and math.cl, and run its kernel `probe` with a work-item per element.

    inputs: arrays (n,). outputs: types of arrays (n,). The kernel's arguments are the inputs, then the
    outputs. Without float64, PROJECTION_FP64 is 0 and `real` is float.
    """
    kernel = compile_test_kernels(workspace, text=text, lanes=1)["probe"]
    input_buffers = [buffer_of(workspace, array) for array in inputs]
    results = [np.empty(len(inputs[0]), dtype) for dtype in outputs]
    result_buffers = [buffer_of(workspace, array) for array in results]
    kernel(workspace.queue, (len(inputs[0]),), None, *input_buffers, *result_buffers)
    for array, buffer in zip(results, result_buffers, strict=True):
        cl.enqueue_copy(workspace.queue, array, buffer)
    return results


class _PoisonedPool(BufferPool):
    def __init__(self, workspace: Workspace) -> None:
        super().__init__(workspace.context, workspace.device)
        self._queue = workspace.queue

    def scratch(self, name: str, size: int) -> cl.Buffer:
        return self._filled(super().scratch(name, size))

    def acquire(self, name: str, size: int, larger: bool = False) -> cl.Buffer:
        return self._filled(super().acquire(name, size, larger))

    def allocate(self, name: str, size: int) -> cl.Buffer:
        return self._filled(super().allocate(name, size))

    def _filled(self, buffer: cl.Buffer) -> cl.Buffer:
        cl.enqueue_fill_buffer(self._queue, buffer, np.full(1, 0xFF, np.uint8), 0, buffer.size)
        return buffer


def contents(workspace: Workspace, buffer: cl.Buffer) -> np.ndarray:
    """The bytes of a buffer (size,) uint8."""
    array = np.empty(buffer.size, np.uint8)
    cl.enqueue_copy(workspace.queue, array, buffer)
    return array


def buffer_of(workspace: Workspace, array: np.ndarray) -> cl.Buffer:
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    return cl.Buffer(workspace.context, flags, hostbuf=np.ascontiguousarray(array))


CONTRACTION = """
kernel void probe(global const float *a, global const float *b, global const float *c,
                  global float *difference, global float *sum, global real *wide, global float *fused) {
    int i = get_global_id(0);
    // a equals c: 0, unless the compiler fuses one of the products into the subtraction
    difference[i] = a[i] * b[i] - c[i] * b[i];
    sum[i] = a[i] * b[i] + c[i];
    wide[i] = (real)a[i] / 3 * ((real)b[i] / 3) - (real)c[i] / 3 * ((real)b[i] / 3);
    float product = a[i] * b[i];
    fused[i] = FMA(a[i], b[i], -product);
}
"""
NOT_A_NUMBER = """
kernel void probe(global const float *x, global int *unequal, global int *is_nan, global int *unordered,
                  global int *infinite) {
    int i = get_global_id(0);
    unequal[i] = x[i] != x[i];
    is_nan[i] = isnan(x[i]);
    unordered[i] = !(x[i] > 0.0f) && !(x[i] <= 0.0f);
    infinite[i] = isinf(x[i]);
}
"""


class OpenCLProbe(Probe):
    @property
    def fuses(self) -> bool:
        """Whether the device fuses multiply-adds where requested."""
        return self._workspace.config.fast_fma

    def contraction(self, a: np.ndarray, b: np.ndarray) -> Sequence[np.ndarray]:
        real = np.float64 if self._workspace.info.float64 else np.float32
        types = (np.float32, np.float32, real, np.float32)
        return evaluate(self._workspace, CONTRACTION, (a, b, a), types)

    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        return evaluate(self._workspace, NOT_A_NUMBER, (x,), (np.int32,) * 4)

    def arithmetic(
        self, exponents: np.ndarray, fractions: np.ndarray, dividends: np.ndarray, divisors: np.ndarray
    ) -> dict[str, np.ndarray]:
        workspace, n = self._workspace, len(exponents)
        kernels = compile_test_kernels(
            workspace, "check/arithmetic.cl", effects=("effect/arithmetic_fast.cl",)
        )

        def run(kernel: str, items: int, result: np.ndarray, *inputs: Any) -> np.ndarray:
            values = [buffer_of(workspace, one) if isinstance(one, np.ndarray) else one for one in inputs]
            out = buffer_of(workspace, result)
            kernels[kernel](workspace.queue, (items,), None, *values, out)
            cl.enqueue_copy(workspace.queue, result, out)
            return result

        single = [array.astype(np.float32) for array in (exponents, fractions, dividends, divisors)]
        names = ("exp", "log", "division", "sqrt", "fma", "fast_exp", "fast_log", "reciprocal")
        single_results, count, items = np.empty((8, n), np.float32), np.uint32(n), n // workspace.config.lanes
        try:
            parts = run("arithmetic_float", items, single_results, count, *single)
            results: dict[str, np.ndarray] = dict(zip(names, parts, strict=True))
            if workspace.info.float64:
                parts = run("arithmetic_real", n, np.empty((3, n)), count, dividends, divisors)
                results |= dict(zip(("division64", "sqrt64", "log64"), parts, strict=True))
            smallest = np.array([np.finfo(np.float32).tiny, 0.5], np.float32)
            results["denormal"] = run("arithmetic_denormal", 1, np.empty(2, np.float32), smallest)
        except cl.Error as error:
            title = workspace.info.title
            raise DeviceError(f"{title} failed in a test of its arithmetic: {error}") from error
        return results

    def options(self) -> list[str]:
        return self._workspace.compiler_options

    def scan(self, pipeline: OpenCLPipeline, lengths: np.ndarray) -> tuple[np.ndarray, int]:
        workspace, items = pipeline.workspace, (pipeline.config.scan_items,)
        starts = buffer_of(workspace, np.empty(len(lengths) + 1, np.uint32))
        sums = buffer_of(workspace, np.zeros(8, np.uint32))
        arguments = {"starts": starts}
        if pipeline.config.binning != "sort_first":
            kernel, total_index, size = "tile_starts", 1, (3 * items[0],)
            arguments |= {"tiles": len(lengths), "capacity": 2**32 - 1, "frame_counts": sums}
            counters = buffer_of(workspace, np.concatenate([np.zeros(8, np.uint32), lengths]))
            arguments |= {"counters": counters, "cursors": buffer_of(workspace, lengths)}
            arguments["tile_order"] = buffer_of(workspace, np.empty_like(lengths))
        else:
            kernel, total_index, size = "scan_bins", 4, items
            arguments |= {
                "bins": len(lengths),
                "totals": buffer_of(workspace, lengths),
                "counters": sums,
                "counter": 4,
            }
        values = [arguments[name] for name in pipeline.source.arguments[kernel]]
        CommandList(pipeline.program).launch(workspace.queue, kernel, size, items, values)
        positions = contents(workspace, starts).view(np.uint32)
        words = contents(workspace, sums).view(np.uint32)
        return positions, int(words[total_index]) | int(words[total_index + 1]) << 32

    def bounding_boxes(self, pipeline: OpenCLPipeline, buffers: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.stack([buffers["records"][name].astype(int) for name in ("x0", "x1", "y0", "y1")], 1)

    def _poisoned_pool(self) -> BufferPool:
        return _PoisonedPool(self._workspace)
