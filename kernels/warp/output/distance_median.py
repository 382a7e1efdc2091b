"""Median distance along the pixel's rays [m], from its samples' median depths."""

from typing import Any

import warp as wp

from ..window import Window, sample_at
from . import Output
from .depth_median import middle_of, sorted_in


@wp.func
def resolve(window: Window, samples: Any, lengths: Any, out: Any):
    medians = type(lengths)()
    hits = int(0)
    for k in range(window.count):
        half = samples.depth_median[sample_at(window, k)]
        if half > 0.0:
            medians = sorted_in(medians, hits, half * lengths[k])
            hits += 1
    out.distance_median[window.pixel] = middle_of(medians, hits)


OUTPUT = Output(needs=("depth_median",), length=True, resolve=resolve)
