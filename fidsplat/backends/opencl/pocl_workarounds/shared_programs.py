"""One context and one copy of each program per PoCL device and process.

PoCL does not free a program that has run: each renderer would leak 3 MB.
Programs and their context are therefore shared by all renderers of a process; kernels, queues and buffers
are not.
"""

from __future__ import annotations

from functools import cache

import pyopencl as cl


@cache
def shared_context(device: cl.Device) -> cl.Context:
    """The context of a device."""
    return cl.Context([device])


@cache
def shared_program(context: cl.Context, text: str, options: tuple[str, ...]) -> cl.Program:
    """The program of a text compiled with these options, in this call or an earlier one."""
    return cl.Program(context, text).build(options=list(options))
