"""A picture of several poses: their samples are gathered in buffers of the whole picture."""

from functools import cache

import warp as wp

from .common import STRICT


@cache
def make_expose(dtype):
    """The kernel that adds a sample buffer of light, weighted, to that of the picture."""

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def expose(
        first: int,  # sample of thread 0
        weight: float,
        fresh: int,  # 1: nothing is there yet
        start: int,  # sample of the picture that is the first of these rows
        raw: wp.array(dtype=dtype),
        exposed: wp.array(dtype=dtype),  # in and out
    ):
        at = wp.tid() + first
        light = weight * raw[at]
        if fresh == 0:
            light = exposed[start + at] + light
        exposed[start + at] = light

    return expose
