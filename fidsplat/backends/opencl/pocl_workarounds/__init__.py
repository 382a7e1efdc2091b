"""Workarounds for faults of PoCL; README.md says which versions need which."""

from contextlib import suppress
from functools import cache

import pyopencl as cl

from fidsplat.backends.opencl.pocl_workarounds.declarations import OPTION, with_builtin_declarations


def is_pocl(device: cl.Device) -> bool:
    """Whether PoCL drives a device."""
    return "Portable Computing Language" in device.platform.name


# PoCL does not free a program that has run: each renderer would leak 3 MB. The renderers of a process share
# programs; each has its own kernels, queues and buffers.


@cache
def shared_program(context: cl.Context, text: str, options: tuple[str, ...]) -> cl.Program:
    """The program of a text compiled with these options, in this call or an earlier one."""
    short = with_builtin_declarations(text, context.devices[0].platform.version)
    if short is not None:
        # the build fails if the text calls a function that the header does not declare, or is invalid
        with suppress(cl.RuntimeError):
            return cl.Program(context, short).build(options=[*options, OPTION])
    return cl.Program(context, text).build(options=list(options))
