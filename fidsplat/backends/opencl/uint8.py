"""Conversion of images to 8 bits on the device (kernels/opencl/uint8.cl)."""

from __future__ import annotations

import math
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.assemble import kernel_text
from fidsplat.backends.opencl.program import build, load_invoker
from fidsplat.backends.opencl.workspace import Workspace

_GROUP = 64
_KERNELS: WeakKeyDictionary[Workspace, tuple[cl.Kernel, int]] = WeakKeyDictionary()
"""kernel, compiled on first use, and values per work-item"""


def read_uint8(
    workspace: Workspace, image: cl.Buffer, index: int, shape: tuple[int, ...], after: list[cl.Event]
) -> np.ndarray:
    """An image of floats as an array of uint8 on the host; waits for the device.

    index: number of the image in the buffer. after: events to wait for.

    Raises:
        DeviceError: no memory, or the compiler refuses.
    """
    into, count = workspace.host_memory.empty(shape, np.uint8), math.prod(shape)
    queue, name = workspace.read_queue, "8 bits of an image"
    with workspace.lock:  # the kernel's arguments are shared by all images
        kernel, values = _kernel(workspace)
        made = workspace.pool.lease(name, count)
        items = -(-count // (values * _GROUP)) * _GROUP
        numbers = np.uint64(count), np.uint64(index * count)
        converted = kernel(queue, (items,), (_GROUP,), *numbers, image, made, wait_for=after)
    try:
        cl.enqueue_copy(queue, into, made, wait_for=[converted])
    finally:
        workspace.pool.give_back([(name, made)])
    return into


def _kernel(workspace: Workspace) -> tuple[cl.Kernel, int]:
    if workspace not in _KERNELS:
        load_invoker()
        values = 16 if workspace.shape.schedule == "lanes" else 4
        program = build(workspace, kernel_text("uint8.cl"), f"-DVALUES={values}")
        _KERNELS[workspace] = program.to_uint8, values
    return _KERNELS[workspace]
