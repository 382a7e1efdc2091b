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
    p.median_light = 1.0
    return p


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    # a run of faint fragments is represented by its last fragment
    if p.t > 0.5 and p.median_light - (p.t - weight) >= MIN_ALPHA:
        p.depth_median = attributes.z
        p.median_light = p.t - weight
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.depth_median[at] = pixel.depth_median


@wp.func
def sorted_in(values: Any, count: int, value: float):
    """Insert a value into `count` sorted values."""
    after = values
    place = count
    while place > 0 and after[wp.max(place - 1, 0)] > value:
        after[place] = after[place - 1]
        place -= 1
    after[place] = value
    return after


@wp.func
def median_of(grid: PixelGrid, samples: Any, lengths: Any, stretched: bool) -> float:
    """Lower median over the samples of a pixel with a median depth, along their rays if `stretched`; 0
    without such samples."""
    medians = type(lengths)()
    hits = int(0)
    for k in range(grid.count):
        half = samples.depth_median[sample_at(grid, k)]
        if half > 0.0:
            if stretched:
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
    # median_light: transmittance behind the last represented fragment
    state={"depth_median": wp.float32, "median_light": wp.float32},
    start=start,
    composite=composite,
    samples={"depth_median": wp.float32},
    store=store,
    resolve=resolve,
)
