"""Fog: blends the colour of a fragment with the fog's colour by its distance along the ray. It changes rgb
and has no output image."""

from typing import Any

import warp as wp

from ..common import View, fma
from ..fast import fast_exp
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def start(pixel: Any, length: float, view: View):
    p = pixel
    p.fog_slope = -view.fog_density * length
    return p


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    absorbed = weight * (1.0 - fast_exp(pixel.fog_slope * attributes.z))
    p.r = fma(-absorbed, attributes.rgb[0], p.r)
    p.g = fma(-absorbed, attributes.rgb[1], p.g)
    p.b = fma(-absorbed, attributes.rgb[2], p.b)
    p.fogged += absorbed
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.fogged[at] = pixel.fogged


@wp.func
def background_share(grid: PixelGrid, samples: Any) -> float:
    """Fraction of the background colour that the fog, which has this colour, adds to a pixel."""
    fogged = float(0.0)
    for k in range(grid.count):
        fogged += samples.fogged[sample_at(grid, k)]
    return fogged * grid.mean


OUTPUT = Output(
    depth=True,
    length=True,
    # fog_slope: -density, per metre of depth; fogged: sum of weights times absorbed fraction
    state={"fog_slope": wp.float32, "fogged": wp.float32},
    start=start,
    composite=composite,
    samples={"fogged": wp.float32},
    store=store,
    averaged=True,
    background_share=background_share,
)
