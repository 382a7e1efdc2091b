"""Upper bound of the float32 rounding error of a pixel's colour, per unit of colour, in frames without a
transmittance stop. Equal to kernels/opencl/output/rounding.cl; fidsplat/render/certified_error.py has the
derivation."""

from typing import Any

import warp as wp

from ..common import View
from ..fast import fast_exp
from ..pixel_grid import PixelGrid, sample_at
from . import Output

UNIT = wp.constant(2.0**-24)
OF_FORM = wp.constant(4.0 * 2.0**-24)  # rounding error of a form, relative to its terms


@wp.func
def terms(form: wp.vec4, x: float, y: float) -> float:
    return wp.abs(form[0]) + wp.abs(form[1] * x) + wp.abs(form[2] * y)


@wp.func
def alpha_rounding(log_opacity: float, half_rho: float) -> float:
    """Relative rounding error of an alpha: of ln(opacity), rho, their difference and the exponential."""
    return UNIT * (16.0 + 2.0 * wp.abs(log_opacity) + 32.0 * wp.min(half_rho, 100.0))


@wp.func
def fragment(pixel: Any, s: Any, c: Any, x: float, y: float, disc: float, alpha: float, view: View):
    off = OF_FORM * (terms(s.u, x, y) + terms(s.v, x, y))
    off_d = OF_FORM * terms(s.d, x, y)
    d_low, d_high, root = c.d - off_d, c.d + off_d, wp.sqrt(c.q)
    nearest, furthest = float(wp.inf), float(wp.inf)
    if d_high > 0.0 and d_low <= (1.0 + OF_FORM) * s.v[3]:
        near = wp.max(root - off, 0.0) / d_high
        nearest = near * near
    if d_low > 0.0 and d_high <= (1.0 - OF_FORM) * s.v[3]:
        far = (root + off) / d_low
        furthest = far * far
    if disc < wp.inf:
        away = wp.sqrt(disc)
        off_dot = OF_FORM * (wp.sqrt(view.sample_area) * (1.0 + 2.0 * (wp.abs(x) + wp.abs(y))) + 3.0 * away)
        least, most = wp.max(away - off_dot, 0.0), away + off_dot
        nearest = wp.min(nearest, least * least)
        furthest = wp.min(furthest, most * most)
    high = wp.min(fast_exp(s.u[3] - nearest) * (1.0 + alpha_rounding(s.u[3], nearest)), 1.0)
    low = fast_exp(s.u[3] - furthest) * (1.0 - alpha_rounding(s.u[3], furthest))
    p = pixel
    p.rounding += p.t * wp.max(high - alpha, alpha - low)
    if c.contributes:
        p.rounding += 1.5 * UNIT
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.rounding[at] = pixel.rounding


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    total = float(0.0)
    for k in range(grid.count):
        total += samples.rounding[sample_at(grid, k)]
    out.rounding[grid.pixel] = total * grid.mean


OUTPUT = Output(
    state={"rounding": wp.float32},
    fragment=fragment,
    samples={"rounding": wp.float32},
    store=store,
    resolve=resolve,
)
