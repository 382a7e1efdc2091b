"""Median depth [m]: where the transmittance of a sample falls below one half; for a pixel, the lower median
over its samples with a median depth, 0 without such samples."""

from typing import Any

import warp as wp

from ..common import MIN_ALPHA, View
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def start(pixel: Any, length: float, view: View):
    p = pixel
    p.median_transmittance = 1.0
    return p


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    # a run of faint fragments is represented by its last fragment
    if p.t > 0.5 and p.median_transmittance - (p.t - weight) >= MIN_ALPHA:
        p.depth_median = attributes.z
        p.median_transmittance = p.t - weight
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.depth_median[at] = pixel.depth_median


@wp.func
def sorted_in(values: Any, count: int, value: float):
    """Insert a value into `count` sorted values."""
    after = values
    position = count
    while position > 0 and after[wp.max(position - 1, 0)] > value:
        after[position] = after[position - 1]
        position -= 1
    after[position] = value
    return after


@wp.func
def median_of(grid: PixelGrid, samples: Any, lengths: Any, has_ray_lengths: bool) -> float:
    """Lower median over the samples of a pixel with a median depth, along their rays if `has_ray_lengths`; 0
    without such samples."""
    medians = type(lengths)()
    hits = int(0)
    for k in range(grid.count):
        half = samples.depth_median[sample_at(grid, k)]
        if half > 0.0:
            if has_ray_lengths:
                half = half * lengths[k]
            medians = sorted_in(medians, hits, half)
            hits += 1
    if hits > 0:
        return medians[(hits - 1) / 2]
    return 0.0


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    out.depth_median[grid.pixel] = median_of(grid, samples, lengths, False)


OUTPUT = Output(
    depth=True,
    # median_transmittance: transmittance behind the last represented fragment
    state={"depth_median": wp.float32, "median_transmittance": wp.float32},
    start=start,
    composite=composite,
    samples={"depth_median": wp.float32},
    store=store,
    resolve=resolve,
)
