"""Pixels from their samples: means, the median of medians, the nearest hit, the splat of largest weight."""

from functools import cache

import warp as wp

from .common import STRICT, View, fma
from .planes import make_outputs, make_samples
from .sight import make_sight


@cache
def make_resolve(
    outputs: tuple[str, ...],
    integers: tuple[str, ...],
    planes: tuple[tuple[str, type], ...],
    stretched: bool,
    samples: int,
):
    """The kernel for these outputs, of which some are integers, from these planes of samples, samples x
    samples per pixel; stretched: a lens gives rays their lengths.
    """
    Samples, Outputs = make_samples(planes), make_outputs(outputs, integers)
    sight = make_sight(stretched, stretched)
    Rays, length_of = sight.Rays, sight.length_of
    has = {name for name, _ in planes}
    depth, median, first, normal, heaviest, blended, fog = (
        name in has
        for name in ("depth", "depth_median", "depth_first", "normal", "heaviest", "blended", "fogged")
    )
    alpha, label, splat_id, normal_world, distance, distance_median, distance_first = (
        name in outputs
        for name in (
            *("alpha", "label", "splat_id", "normal_world"),
            *("distance", "distance_median", "distance_first"),
        )
    )
    lengths = distance or distance_median or distance_first
    n = samples
    mean = 1.0 / (n * n)
    several = wp.types.vector(n * n, wp.float32)

    @wp.func
    def sorted_in(values: several, count: int, value: float):
        """`count` values in order and one more."""
        after = values
        place = count
        while place > 0 and after[wp.max(place - 1, 0)] > value:
            after[place] = after[place - 1]
            place -= 1
        after[place] = value
        return after

    @wp.func
    def middle_of(values: several, count: int) -> float:
        """The lower median of `count` values in order; 0 of none."""
        if count > 0:
            return values[(count - 1) / 2]
        return 0.0

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def resolve(
        first_pixel: int,  # of thread 0
        view: View,
        width: int,  # of the picture
        background: wp.vec3,
        rays: Rays,
        samples: Samples,
        out: Outputs,
    ):
        pixel = wp.tid() + first_pixel
        x = (pixel % width) * n
        y = (pixel / width) * n
        stride = view.tiles_x * view.tile_w
        total = wp.vec4()
        fogged = float(0.0)
        z = wp.vec2()
        along = float(0.0)
        medians = several()
        medians_along = several()
        hits = int(0)
        nearest = float(wp.inf)
        nearest_along = float(wp.inf)
        facing = wp.vec3()
        weight = float(0.0)
        which = int(-1)
        count = int(0)
        for sample in range(wp.static(n * n)):
            column = x + sample % n
            row = y + sample / n
            at = row * stride + column
            total += samples.color[at]
            length = float(1.0)
            if wp.static(lengths):
                length = length_of(column, row, rays, view)
            if wp.static(fog):
                fogged += samples.fogged[at]
            if wp.static(depth):
                here = samples.depth[at]
                z += here
                if wp.static(distance):
                    along = fma(here[0], length, along)
            if wp.static(median):
                half = samples.depth_median[at]
                if half > 0.0:
                    medians = sorted_in(medians, hits, half)
                    if wp.static(distance_median):
                        medians_along = sorted_in(medians_along, hits, half * length)
                    hits += 1
            if wp.static(first):
                hit = samples.depth_first[at]
                if hit > 0.0:
                    nearest = wp.min(nearest, hit)
                    if wp.static(distance_first):
                        nearest_along = wp.min(nearest_along, hit * length)
            if wp.static(normal):
                facing += samples.normal[at]
            if wp.static(heaviest):
                if samples.weight[at] > weight:
                    weight = samples.weight[at]
                    which = samples.heaviest[at]
            if wp.static(blended):
                count = wp.max(count, samples.blended[at])
        t = total[3] * mean
        # fog is of one colour with what lies behind everything
        left = t
        if wp.static(fog):
            left += fogged * mean
        for channel in range(3):
            out.rgb[3 * pixel + channel] = fma(left, background[channel], total[channel] * mean)
        if wp.static(alpha):
            out.alpha[pixel] = 1.0 - t
        if wp.static(depth):
            out.depth[pixel] = wp.where(z[1] > 0.0, z[0] / z[1], 0.0)
            if wp.static(distance):
                out.distance[pixel] = wp.where(z[1] > 0.0, along / z[1], 0.0)
        if wp.static(median):
            out.depth_median[pixel] = middle_of(medians, hits)
            if wp.static(distance_median):
                out.distance_median[pixel] = middle_of(medians_along, hits)
        if wp.static(first):
            out.depth_first[pixel] = wp.where(nearest < wp.inf, nearest, 0.0)
            if wp.static(distance_first):
                out.distance_first[pixel] = wp.where(nearest_along < wp.inf, nearest_along, 0.0)
        if wp.static(normal):
            length_of_sum = wp.length(facing)
            unit = wp.vec3()
            if length_of_sum > 0.0:
                unit = facing / length_of_sum
            for channel in range(3):
                out.normal[3 * pixel + channel] = unit[channel]
            if wp.static(normal_world):
                turned = wp.transpose(out.turns[pixel / width]) * unit
                for channel in range(3):
                    out.normal_world[3 * pixel + channel] = turned[channel]
        if wp.static(splat_id):
            out.splat_id[pixel] = which
        if wp.static(label):
            name = int(-1)
            if which >= 0:
                name = out.labels[which]
            out.label[pixel] = name
        if wp.static(blended):
            out.blended[pixel] = count

    return resolve
