"""One context and one copy of each program per PoCL device and process.

PoCL does not free a program that has run: 3 MB for each renderer that was opened, rendered and dropped.
Programs and their context are therefore shared by all renderers of a process; kernels, queues and buffers
are not.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pyopencl as cl

_programs: dict[tuple[cl.Context, str, tuple[str, ...]], cl.Program] = {}


@cache
def shared_context(device: cl.Device) -> cl.Context:
    """The context of a device."""
    return cl.Context([device])


def shared_program(
    context: cl.Context, text: str, options: tuple[str, ...], build: Callable[[], cl.Program]
) -> cl.Program:
    """The program that `build` has made of a text with these options, in this call or an earlier one."""
    key = context, text, options
    if key not in _programs:
        _programs[key] = build()
    return _programs[key]
