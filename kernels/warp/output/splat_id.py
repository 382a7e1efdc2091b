"""The index of the splat of the largest weight; -1 where nothing shows."""

from typing import Any

import warp as wp

from ..window import Window
from . import Output
from .heaviest import heaviest_of


@wp.func
def resolve(window: Window, samples: Any, lengths: Any, out: Any):
    out.splat_id[window.pixel] = heaviest_of(window, samples)


OUTPUT = Output(needs=("heaviest",), resolve=resolve)
