"""Which share of a pixel the splats cover: 1 less what they transmit."""

from typing import Any

import warp as wp

from ..window import Window, sample_at
from . import Output


@wp.func
def resolve(window: Window, samples: Any, lengths: Any, out: Any):
    t = float(0.0)
    for k in range(window.count):
        t += samples.color[sample_at(window, k)][3]
    out.alpha[window.pixel] = 1.0 - t * window.mean


OUTPUT = Output(resolve=resolve)
