"""Looks into an open device: small kernels under the build options and the pragmas of the stages, single
stages on made-up input, and buffers that are filled with rubbish first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.assemble import kernel_text, with_scalars
from fidsplat.backends.opencl.backend import OpenCLBackend
from fidsplat.backends.opencl.memory import BufferPool
from fidsplat.backends.opencl.pipeline import OpenCLPipeline


def evaluate(
    backend: OpenCLBackend, text: str, inputs: Sequence[np.ndarray], outputs: Sequence[np.dtype | type]
) -> list[np.ndarray]:
    """Run `kernel void probe(...)` of `text`, compiled as the stages are: after prelude.cl and math.cl.

    One work-item per element: inputs are arrays (n,) of one length, outputs the types of arrays (n,). The
    kernel's arguments are the pointers to the inputs, then to the outputs. A device without float64 has
    SETUP_FP64 0 and `real` is float.

    Raises:
        DeviceError: the compiler refuses.
    """
    defines = {
        "LANES": 1,
        "FAST_FMA": int(backend.shape.fast_fma),
        "SETUP_FP64": int(backend.info.float64),
    }
    head = "".join(f"#define {name} {value}\n" for name, value in defines.items())
    stages = kernel_text("prelude.cl") + kernel_text("math.cl")
    program = backend.build(with_scalars(head + stages) + text)
    given = [buffer_of(backend, array) for array in inputs]
    made = [np.empty(len(inputs[0]), dtype) for dtype in outputs]
    taken = [buffer_of(backend, array) for array in made]
    program.probe(backend.queue, (len(inputs[0]),), None, *given, *taken)
    for array, buffer in zip(made, taken, strict=True):
        cl.enqueue_copy(backend.queue, array, buffer)
    return made


class _PoisonedPool(BufferPool):
    def __init__(self, backend: OpenCLBackend) -> None:
        super().__init__(backend.context, backend.device)
        self._queue = backend.queue

    def scratch(self, name: str, size: int) -> cl.Buffer:
        return self._filled(super().scratch(name, size))

    def lease(self, name: str, size: int) -> cl.Buffer:
        return self._filled(super().lease(name, size))

    def fresh(self, name: str, size: int) -> cl.Buffer:
        return self._filled(super().fresh(name, size))

    def _filled(self, buffer: cl.Buffer) -> cl.Buffer:
        cl.enqueue_fill_buffer(self._queue, buffer, np.full(1, 0xFF, np.uint8), 0, buffer.size)
        return buffer


def contents(backend: OpenCLBackend, buffer: cl.Buffer) -> np.ndarray:
    """The bytes of a buffer (size,) uint8."""
    array = np.empty(buffer.size, np.uint8)
    cl.enqueue_copy(backend.queue, array, buffer)
    return array


def buffer_of(backend: OpenCLBackend, array: np.ndarray) -> cl.Buffer:
    """An array in a buffer of its own."""
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    return cl.Buffer(backend.context, flags, hostbuf=np.ascontiguousarray(array))


CONTRACTION = """
kernel void probe(global const float *a, global const float *b, global const float *c,
                  global float *difference, global float *sum, global real *wide, global float *fused) {
    int i = get_global_id(0);
    difference[i] = a[i] * b[i] - c[i] * b[i];      // a is c: 0 unless one product is not rounded
    sum[i] = a[i] * b[i] + c[i];
    wide[i] = (real)a[i] / 3 * ((real)b[i] / 3) - (real)c[i] / 3 * ((real)b[i] / 3);
    float product = a[i] * b[i];
    fused[i] = FMA(a[i], b[i], -product);
}
"""
NOT_A_NUMBER = """
kernel void probe(global const float *x, global int *unequal, global int *named, global int *survives,
                  global int *infinite) {
    int i = get_global_id(0);
    unequal[i] = x[i] != x[i];
    named[i] = isnan(x[i]);
    survives[i] = !(x[i] > 0.0f) && !(x[i] <= 0.0f);
    infinite[i] = isinf(x[i]);
}
"""


class OpenCLProbe:
    """Small kernels under the build options and the pragmas of the stages, single stages on made-up input,
    and buffers that are filled with rubbish first: `Probe` of fidsplat/backends/base.py."""

    def __init__(self, backend: OpenCLBackend) -> None:
        self._backend = backend

    def contraction(self, a: np.ndarray, b: np.ndarray) -> tuple[list[np.ndarray], bool]:
        """a b - a b; a b + a; the difference in the set-up's precision, of thirds; a b - (a b), fused: each
        (n,), from a, b (n,) float32. And whether the device fuses where it is asked to.
        """
        real = np.float64 if self._backend.info.float64 else np.float32
        types = (np.float32, np.float32, real, np.float32)
        return evaluate(self._backend, CONTRACTION, (a, b, a), types), self._backend.shape.fast_fma

    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        """Of x (n,) float32: x != x, isnan, fails every comparison, isinf; each (n,) int32."""
        return evaluate(self._backend, NOT_A_NUMBER, (x,), (np.int32,) * 4)

    def options(self) -> list[str]:
        """What every program is compiled with."""
        return self._backend.build_options

    def scan(self, pipeline: OpenCLPipeline, lengths: np.ndarray) -> tuple[np.ndarray, int]:
        """What the device makes of lengths of lists (n,) uint32: where each list starts (n + 1,) uint32,
        and the sum of all in 64 bits.
        """
        backend, items = pipeline.backend, (pipeline.shape.scan_items,)
        count, starts = np.uint32(len(lengths)), buffer_of(backend, np.empty(len(lengths) + 1, np.uint32))
        sums = buffer_of(backend, np.zeros(8, np.uint32))
        if pipeline.shape.lists == "tiled":
            tallies = buffer_of(backend, np.concatenate([np.zeros(8, np.uint32), lengths]))
            cursors = buffer_of(backend, lengths)
            args = (count, np.uint32(2**32 - 1), tallies, starts, cursors, sums)
            kernel, place = "tile_starts", 1
        else:
            totals = buffer_of(backend, lengths)
            args, kernel, place = (count, totals, starts, sums, np.uint32(4)), "scan_bins", 4
        pipeline.launch(backend.queue, kernel, items, items, args)
        places = contents(backend, starts).view(np.uint32)
        words = contents(backend, sums).view(np.uint32)
        return places, int(words[place]) | int(words[place + 1]) << 32

    @contextmanager
    def poisoned(self) -> Iterator[None]:
        """Within it, every buffer that a picture takes is filled with 0xFF first: NaN, or the integer -1."""
        pool = self._backend.pool
        self._backend.pool = _PoisonedPool(self._backend)
        try:
            yield
        finally:
            self._backend.pool = pool
