"""Pixels from their samples: means, the median of medians, the label of the largest weight."""

from functools import cache

import warp as wp

from .common import STRICT, View, fma


@cache
def make_resolve(taps: tuple[str, ...], samples: int):
    """The kernel for these planes and samples x samples per pixel."""
    alpha, depth, median, normal, label = (
        name in taps for name in ("alpha", "depth", "depth_median", "normal", "label")
    )
    n = samples
    mean = 1.0 / (n * n)
    several = wp.types.vector(n * n, wp.float32)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def resolve(
        first: int,  # pixel of thread 0
        view: View,
        width: int,  # of the picture
        raw: wp.array(dtype=wp.vec4),
        raw_depth: wp.array(dtype=wp.vec2),
        raw_median: wp.array(dtype=wp.float32),
        raw_normal: wp.array(dtype=wp.vec3),
        raw_label: wp.array(dtype=wp.int32),
        raw_label_weight: wp.array(dtype=wp.float32),
        rgb_out: wp.array(dtype=wp.float32),  # (h w 3)
        alpha_out: wp.array(dtype=wp.float32),  # (h w), as those below
        depth_out: wp.array(dtype=wp.float32),
        median_out: wp.array(dtype=wp.float32),
        normal_out: wp.array(dtype=wp.float32),  # (h w 3)
        label_out: wp.array(dtype=wp.int32),
    ):
        out = wp.tid() + first
        x = (out % width) * n
        y = (out / width) * n
        stride = view.tiles_x * view.tile_w
        total = wp.vec4()
        z = wp.vec2()
        facing = wp.vec3()
        medians = several()
        hits = int(0)
        heaviest = float(0.0)
        name = int(-1)
        for sample in range(wp.static(n * n)):
            at = (y + sample / n) * stride + x + sample % n
            total += raw[at]
            if wp.static(depth):
                z += raw_depth[at]
            if wp.static(median):
                here = raw_median[at]
                if here > 0.0:
                    place = hits
                    while place > 0 and medians[wp.max(place - 1, 0)] > here:
                        medians[place] = medians[place - 1]
                        place -= 1
                    medians[place] = here
                    hits += 1
            if wp.static(normal):
                facing += raw_normal[at]
            if wp.static(label):
                if raw_label_weight[at] > heaviest:
                    heaviest = raw_label_weight[at]
                    name = raw_label[at]
        t = total[3] * mean
        for channel in range(3):
            rgb_out[3 * out + channel] = fma(t, view.background[channel], total[channel] * mean)
        if wp.static(alpha):
            alpha_out[out] = 1.0 - t
        if wp.static(depth):
            depth_out[out] = wp.where(z[1] > 0.0, z[0] / z[1], 0.0)
        if wp.static(median):
            middle = float(0.0)
            if hits > 0:
                middle = medians[(hits - 1) / 2]
            median_out[out] = middle
        if wp.static(normal):
            length = wp.length(facing)
            for channel in range(3):
                normal_out[3 * out + channel] = wp.where(length > 0.0, facing[channel] / length, 0.0)
        if wp.static(label):
            label_out[out] = name

    return resolve
