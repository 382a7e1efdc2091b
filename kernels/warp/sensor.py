"""Sensor model: kernel of the post-processing steps of post/ for each pixel."""

from functools import cache

import warp as wp

from . import post
from .common import STRICT, struct_of


@cache
def make_sensor(steps: tuple[str, ...]):
    """Make the kernel of these steps, applied in order, and the struct of their inputs."""
    declared = [post.declared(name) for name in steps]
    fields = {name: kind for step in declared for name, kind in step.numbers.items()}
    fields |= {name: wp.array(dtype=kind) for step in declared for name, kind in step.arrays.items()}
    Settings = struct_of("Settings", "Inputs of the steps.", fields)
    applied = tuple(step.apply for step in declared)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def sensor(
        first: int,  # pixel of thread 0; pixels are numbered view after view
        settings: Settings,
        width: int,  # columns of an image
        pixels: int,  # number of pixels of an image
        batch_indices: wp.array(dtype=wp.int32),  # (views) index of each view in the images
        rgb: wp.array(dtype=wp.float32),  # (images h w 3) in and out
    ):
        position = wp.tid() + first
        here = position % pixels
        at = batch_indices[position / pixels] * pixels + here
        for channel in range(3):
            v = rgb[3 * at + channel]
            for k in range(wp.static(len(applied))):
                v = wp.static(applied[k])(v, here % width, here / width, channel, settings)
            rgb[3 * at + channel] = v

    return sensor, Settings
