"""Accumulation of sub-frames: adds the samples of all poses of a shutter to the frame's buffers."""

from functools import cache

import warp as wp

from .common import STRICT


@cache
def make_accumulate(dtype):
    """Make the kernel that adds a sub-frame's weighted sample buffer to the frame's buffer."""

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def accumulate(
        first: int,  # sample of thread 0
        weight: float,
        first_sub_frame: int,  # 1: overwrite the buffer, for the first sub-frame
        start: int,  # the frame's first sample in these rows
        raw: wp.array(dtype=dtype),
        accumulated: wp.array(dtype=dtype),  # in and out
    ):
        at = wp.tid() + first
        value = weight * raw[at]
        if first_sub_frame == 0:
            value = accumulated[start + at] + value
        accumulated[start + at] = value

    return accumulate
