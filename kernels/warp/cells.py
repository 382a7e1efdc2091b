"""Culling by cells of a tile: bits of the cells, of 2 x 4 samples, that a splat may overlap. The test is
conservative; each sample has an exact test.

A disk has fragments where f = n_u^2 + n_v^2 - h D^2 <= 0, with h half the squared radius and n_u, n_v, D
affine in the sample. Along a row, with a = (n_u, n_v, D) per x and b = (n_u, n_v, D) at x = 0,
f = <a, a> x^2 + 2 <a, b> x + <b, b> in the product <a, b> = a_u b_u + a_v b_v - h a_D b_D. The row overlaps
the disk where q = <a, b>^2 - <a, a> <b, b> = h |(a x b)_uD, (a x b)_vD|^2 - (a x b)_uv^2 >= 0. a x b is
affine in y, so no large terms cancel in q. Behind a lens, and for boxes, only the bounding box of the record
is tested.
"""

from functools import cache

import warp as wp

from .common import View, fast_reciprocal, fast_sqrt
from .ellipsoids import EXACT
from .records import BOXES
from .splat import make_splat

CELL_W, CELL_H = 2, 4
_SLACK = wp.constant(2e-5)
"""slack relative to the terms of the forms: more than the rounding error of f, here and in the per-sample
test"""
_PAD, _PAD_RELATIVE = wp.constant(0.02), wp.constant(1e-4)
"""padding of chords: in samples, and relative to the distance of the tile from the splat's anchor"""
_FLAT, _NO_DISC = wp.constant(1e-12), wp.constant(1e17)
_ONE, _TWO = wp.constant(wp.uint32(1)), wp.constant(wp.uint32(2))


@wp.struct
class Conic:
    """An ellipse, relative to the splat's anchor."""

    known: bool  # false: no ellipse, or the horizon is near, or the splat is edge-on to rows or columns
    middle: float  # midpoints of chords: middle + slope y
    slope: float
    y: float
    half_height: float
    square: float  # squared half chord of row r: square - bend (r - y)^2
    bend: float
    tip: float  # row of the rightmost point minus y
    pad: float


@wp.func
def half_chord(c: Conic, y: float) -> float:
    above = y - c.y
    return fast_sqrt(wp.max(c.square - c.bend * above * above, 0.0)) + c.pad


@cache
def make_cells(effects: tuple[str, ...], outputs: tuple[str, ...]):
    """Make the function that returns the cells of a tile that a splat may overlap."""
    splats = make_splat(effects, outputs)
    Splat, has_lowpass_disc, thick = splats.Splat, "lowpass_screen" in effects, EXACT in effects
    elliptic = "rays" not in effects and not any(name in effects for name in BOXES)

    @wp.func
    def conic_of(s: Splat, far_x: float, far_y: float):
        """Ellipse of a disk. far_x, far_y: maximum distance of the tile's samples from the anchor."""
        h = s.half_r2
        if wp.static(thick):
            # q <= h (D^2 + ellipsoid_term q); near 1 the rounding of the difference exceeds _SLACK
            if s.ellipsoid_term > 0.0:
                if s.ellipsoid_term * h < 0.95:
                    h = h / (1.0 - s.ellipsoid_term * h)
                else:
                    h = wp.inf
        u0, ux, uy = s.u[0], s.u[1], s.u[2]
        v0, vx, vy = s.v[0], s.v[1], s.v[2]
        d0, dx, dy = s.d[0], s.d[1], s.d[2]
        u = wp.abs(u0) + wp.abs(ux) * far_x + wp.abs(uy) * far_y
        v = wp.abs(v0) + wp.abs(vx) * far_x + wp.abs(vy) * far_y
        d = wp.abs(d0) + wp.abs(dx) * far_x + wp.abs(dy) * far_y
        steep = ux * ux + vx * vx
        bent = h * dx * dx
        inverse = fast_reciprocal(steep - bent)
        # components of a x b: at y = 0, and per y
        ud, vd, uv = ux * d0 - dx * u0, vx * d0 - dx * v0, ux * v0 - vx * u0
        ud_y, vd_y, uv_y = ux * dy - dx * uy, vx * dy - dx * vy, ux * vy - vx * uy
        # q = q0 + 2 q1 y - q2 y^2
        slack = _SLACK * (u * u + v * v + h * d * d) * (steep - bent)
        q0 = h * (ud * ud + vd * vd) - uv * uv + slack
        q1 = h * (ud * ud_y + vd * vd_y) - uv * uv_y
        grows = h * (ud_y * ud_y + vd_y * vd_y)
        q2 = uv_y * uv_y - grows
        shrinks = fast_reciprocal(q2)
        c = Conic()
        c.middle = (h * dx * d0 - ux * u0 - vx * v0) * inverse
        c.slope = (h * dx * dy - ux * uy - vx * vy) * inverse
        c.y = q1 * shrinks
        square_height = wp.max(q0 * shrinks + c.y * c.y, 0.0)
        c.known = steep > _FLAT and bent <= 0.5 * steep and uv_y * uv_y > _FLAT * steep
        c.known = c.known and grows <= 0.5 * uv_y * uv_y
        c.known = c.known and q0 < wp.inf and wp.abs(c.y) < wp.inf
        c.bend = q2 * inverse * inverse
        c.square = square_height * c.bend
        c.pad = _PAD + _PAD_RELATIVE * far_x
        c.half_height = fast_sqrt(square_height) + _PAD + _PAD_RELATIVE * far_y
        steepness = fast_sqrt(c.slope * c.slope * square_height + c.square + _FLAT)
        c.tip = c.slope * square_height * fast_reciprocal(steepness)
        return c

    @wp.func
    def chord(c: Conic, y0: float, y1: float):
        """Columns in which rows y0 to y1 overlap the ellipse."""
        low, high = -float(wp.inf), float(wp.inf)
        if c.known:
            if y0 - c.y > c.half_height or c.y - y1 > c.half_height:
                low, high = float(wp.inf), -float(wp.inf)
            else:
                left, right = wp.clamp(c.y - c.tip, y0, y1), wp.clamp(c.y + c.tip, y0, y1)
                low = c.middle + c.slope * left - half_chord(c, left)
                high = c.middle + c.slope * right + half_chord(c, right)
        return low, high

    @wp.func
    def touched(s: Splat, box: wp.vec4i, left: int, top: int, group: int, view: View) -> wp.uint32:
        """Bits of cells 32 group to 32 group + 31 of the tile whose first sample is (left, top), row by row.
        box: columns [first, end) and rows [first, end) of samples that the splat may overlap.
        """
        across = view.tile_w / CELL_W
        rows = 32 / across  # of cells of a group
        first_row = wp.max(wp.max(box[2] - top, 0) / CELL_H, group * rows)
        end_row = wp.min((wp.min(box[3] - top, view.tile_h) + CELL_H - 1) / CELL_H, group * rows + rows)
        shift, last = s.d[3] - float(left), float(view.tile_w - 1)
        c = Conic()
        if wp.static(elliptic):
            far_x = wp.max(wp.abs(shift), wp.abs(shift - float(view.tile_w)))
            above = float(top) - s.c[0]
            c = conic_of(s, far_x, wp.max(wp.abs(above), wp.abs(above + float(view.tile_h))))
        lowpass_square = s.half_r2 * fast_reciprocal(view.sample_area) * (1.0 + _PAD_RELATIVE)
        bits = wp.uint32(0)
        for row in range(first_row, end_row):
            y0 = float(top + row * CELL_H) - s.c[0]
            y1 = y0 + float(CELL_H - 1)
            low, high = -float(wp.inf), float(wp.inf)
            if wp.static(elliptic):
                low, high = chord(c, y0, y1)
                if wp.static(has_lowpass_disc):
                    away = wp.clamp(s.lowpass_y, y0, y1) - s.lowpass_y
                    rest = lowpass_square - away * away
                    if rest >= 0.0 and s.lowpass_x < _NO_DISC:
                        half = fast_sqrt(rest) + _PAD
                        low, high = wp.min(low, s.lowpass_x - half), wp.max(high, s.lowpass_x + half)
            first = wp.max(int(wp.clamp(wp.ceil(low + shift), 0.0, last + 1.0)), box[0] - left)
            end = wp.min(int(wp.clamp(wp.floor(high + shift), -1.0, last)), box[1] - left - 1)
            if first <= end:
                columns = (_TWO << wp.uint32(end / CELL_W)) - (_ONE << wp.uint32(first / CELL_W))
                bits = bits | columns << wp.uint32((row - group * rows) * across)
        return bits

    return touched
