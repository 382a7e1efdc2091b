"""Conversion of an image to 8 bits on the device, bit-identical to `to_uint8` of fidsplat/images/files.py."""

import warp as wp

from .common import STRICT


@wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
def to_uint8(
    values: wp.array(dtype=wp.float32),
    result: wp.array(dtype=wp.uint8),  # (count) out
):
    at = wp.tid()
    value = values[at]
    if not value > 0.0:  # also for NaN
        value = 0.0
    result[at] = wp.uint8(wp.rint(wp.min(value, 1.0) * 255.0))
