"""Sums over the device in a fixed order of additions, without atomics, so that results are bit-identical on
every run."""

import warp as wp

from .common import STRICT

wp.set_module_options(STRICT)


@wp.kernel(enable_backward=False)
def add_rows(
    first: int,
    rows: int,
    columns: int,
    stride: int,  # thread k sums rows k, k + stride, ...
    parts: wp.array(dtype=wp.float64),  # (rows, columns)
    sums: wp.array(dtype=wp.float64),  # (stride, columns) out
):
    thread = first + wp.tid()
    column = thread % columns
    total = wp.float64(0.0)
    row = thread / columns
    while row < rows:
        total += parts[row * columns + column]
        row += stride
    sums[thread] = total


@wp.kernel(enable_backward=False)
def as_single(first: int, sums: wp.array(dtype=wp.float64), singles: wp.array(dtype=wp.float32)):
    k = first + wp.tid()
    singles[k] = float(sums[k])


@wp.kernel(enable_backward=False)
def background_parts(
    first: int,
    pixels: int,
    width: int,
    stride: int,  # samples per row of the padded grid
    threads: int,  # number of threads
    color: wp.array(dtype=wp.vec4),  # samples: r, g, b, transmittance
    grad_rgb: wp.array(dtype=wp.float32),  # (h w 3)
    # (threads, 3) out: partial sums of the gradient with respect to the background
    parts: wp.array(dtype=wp.float64),
):
    thread = first + wp.tid()
    total = wp.vec3d()
    pixel = thread
    while pixel < pixels:
        left = wp.float64(color[pixel / width * stride + pixel % width][3])
        for channel in range(3):
            total[channel] = total[channel] + left * wp.float64(grad_rgb[3 * pixel + channel])
        pixel += threads
    for channel in range(3):
        parts[3 * thread + channel] = total[channel]


@wp.kernel(enable_backward=False)
def add_to(sums: wp.array2d(dtype=wp.float32), values: wp.array2d(dtype=wp.float32)):
    row, column = wp.tid()
    sums[row, column] = sums[row, column] + values[row, column]
