"""Accumulation of sub-frames: the samples of all poses of a shutter are added up in the frame's buffers."""

from functools import cache

import warp as wp

from .common import STRICT


@cache
def make_expose(dtype):
    """Make the kernel that adds a sub-frame's weighted sample buffer to that of the frame."""

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def expose(
        first: int,  # sample of thread 0
        weight: float,
        fresh: int,  # 1: overwrite the buffer, for the first sub-frame
        start: int,  # sample of the frame that is the first of these rows
        raw: wp.array(dtype=dtype),
        exposed: wp.array(dtype=dtype),  # in and out
    ):
        at = wp.tid() + first
        light = weight * raw[at]
        if fresh == 0:
            light = exposed[start + at] + light
        exposed[start + at] = light

    return expose
