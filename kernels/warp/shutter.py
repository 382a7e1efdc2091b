"""Accumulation of sub-frames: adds the samples of all poses of a shutter to the frame's buffers."""

from functools import cache

import warp as wp

from .common import STRICT


@cache
def make_expose(dtype):
    """Make the kernel that adds a sub-frame's weighted sample buffer to the frame's buffer."""

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def expose(
        first: int,  # sample of thread 0
        weight: float,
        fresh: int,  # 1: overwrite the buffer, for the first sub-frame
        start: int,  # the frame's first sample in these rows
        raw: wp.array(dtype=dtype),
        exposed: wp.array(dtype=dtype),  # in and out
    ):
        at = wp.tid() + first
        light = weight * raw[at]
        if fresh == 0:
            light = exposed[start + at] + light
        exposed[start + at] = light

    return expose
