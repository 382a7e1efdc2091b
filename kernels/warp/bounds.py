"""Image bounds of splats: an ellipse, or a box if the splat crosses the near plane; and the circle of the
low-pass filter. The tiles of most splats are stored as a window: a bit mask of 8 x 4 tiles.

All bounds are conservative; each sample has an exact test.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, divide, fma, population, to_sample

# margins for the rounding of the fields and of the per-sample test: in samples, and relative
PAD = wp.constant(0.02)
PAD_RELATIVE = wp.constant(2e-4)
WINDOW_W = 8
WINDOW_H = 4


@wp.struct
class Bounds:
    """At height h from the centre the ellipse reaches from shear h - w to shear h + w, w = half_width sqrt(1
    - h^2 inverse_hy2).
    """

    x: float
    y: float
    half_x: float
    half_y: float
    shear: float
    half_width: float
    inverse_hy2: float  # 0: a box
    tip: float  # height of the rightmost point of the ellipse
    lowpass_x: float
    lowpass_y: float
    lowpass_r: float  # radius of the low-pass disc; below 0: no disc


@wp.func
def box_bounds(x0: float, x1: float, y0: float, y1: float):
    """The box [x0, x1] x [y0, y1]."""
    b = Bounds()
    b.x = 0.5 * (x0 + x1)
    b.y = 0.5 * (y0 + y1)
    b.half_x = 0.5 * (x1 - x0) * (1.0 + PAD_RELATIVE) + PAD
    b.half_y = 0.5 * (y1 - y0) * (1.0 + PAD_RELATIVE) + PAD
    b.half_width = b.half_x
    b.lowpass_r = -1.0
    return b


@wp.func
def ellipse_bounds(x: float, y: float, half_x: float, half_y: float, shear: float, across: float, tip: float):
    """The ellipse around (x, y) whose chord at height h is shear h +- across sqrt(1 - h^2 / half_y^2)."""
    b = Bounds()
    b.x = x
    b.y = y
    b.half_x = half_x * (1.0 + PAD_RELATIVE) + PAD
    b.half_y = half_y * (1.0 + PAD_RELATIVE) + PAD
    b.shear = shear
    b.tip = tip
    # padding the height also shifts a sheared chord
    b.half_width = across * (1.0 + PAD_RELATIVE) + PAD_RELATIVE * half_x + PAD * (1.0 + wp.abs(shear))
    b.inverse_hy2 = 1.0 / (b.half_y * b.half_y)
    b.lowpass_r = -1.0
    return b


@wp.func
def ones(count: int) -> wp.uint32:
    """A word with the lowest `count` bits set, 1 to 31."""
    return (wp.uint32(1) << wp.uint32(count)) - wp.uint32(1)


@wp.func
def window_tile(corner: int, bit: int, view: View) -> int:
    """The tile of a bit of the window with its first tile at `corner`."""
    return corner + bit / WINDOW_W * view.tiles_x + bit % WINDOW_W


@cache
def make_bounds(has_lowpass_disc: bool) -> SimpleNamespace:
    """Make functions that return the rows, columns and tiles that bounds overlap, with or without the
    low-pass disc."""

    @wp.func
    def rows(b: Bounds, height: int):
        """Rows of samples [first, end) whose centres may be inside the bounds."""
        low = b.y - b.half_y
        high = b.y + b.half_y
        if wp.static(has_lowpass_disc):
            if b.lowpass_r >= 0.0:
                low = wp.min(low, b.lowpass_y - b.lowpass_r)
                high = wp.max(high, b.lowpass_y + b.lowpass_r)
        first = wp.max(to_sample(wp.ceil(low - 0.5), height), 0)
        end = wp.min(to_sample(wp.floor(high - 0.5) + 1.0, height), height)
        return first, end

    @wp.func
    def span(b: Bounds, y0: int, y1: int, width: int):
        """Columns [first, end) of samples in rows [y0, y1) that may be inside the bounds."""
        top = float(y0) + 0.5
        bottom = float(y1) - 0.5
        x0 = float(wp.inf)
        x1 = -float(wp.inf)
        low = wp.max(top - b.y, -b.half_y)
        high = wp.min(bottom - b.y, b.half_y)
        if low <= high:
            right = wp.clamp(b.tip, low, high)
            left = wp.clamp(-b.tip, low, high)
            # 4e-7: 1 - h^2 / hy^2 cancels at the tips
            over = wp.sqrt(wp.max(1.0 - right * right * b.inverse_hy2, 0.0) + 4e-7)
            under = wp.sqrt(wp.max(1.0 - left * left * b.inverse_hy2, 0.0) + 4e-7)
            x1 = b.x + wp.min(fma(b.shear, right, b.half_width * over), b.half_x)
            x0 = b.x + wp.max(fma(b.shear, left, -b.half_width * under), -b.half_x)
        if wp.static(has_lowpass_disc):
            low = wp.max(top - b.lowpass_y, -b.lowpass_r)
            high = wp.min(bottom - b.lowpass_y, b.lowpass_r)
            if low <= high:
                at = wp.clamp(0.0, low, high)
                half = wp.sqrt(wp.max(b.lowpass_r * b.lowpass_r - at * at, 0.0)) + PAD
                x0 = wp.min(x0, b.lowpass_x - half)
                x1 = wp.max(x1, b.lowpass_x + half)
        first = wp.max(to_sample(wp.ceil(x0 - 0.5), width), 0)
        end = wp.min(to_sample(wp.floor(x1 - 0.5) + 1.0, width), width)
        return first, end

    @wp.func
    def tile_rows(b: Bounds, view: View):
        """Rows of tiles [first, end)."""
        first, end = rows(b, view.height)
        return divide(first, view.tile_h), divide(end + view.tile_h - 1, view.tile_h)

    @wp.func
    def tile_span(b: Bounds, row: int, view: View):
        """Tiles [first, end) of a row of tiles. Counting and listing both call this function, so that they
        agree.
        """
        y0 = row * view.tile_h
        first, end = span(b, y0, wp.min(y0 + view.tile_h, view.height), view.width)
        if first >= end:
            return 0, 0
        return divide(first, view.tile_w), divide(end + view.tile_w - 1, view.tile_w)

    @wp.func
    def tile_rectangle(b: Bounds, view: View):
        """Rectangle that contains the tiles of `tile_span` in all rows: left, top, columns, rows."""
        low, high = b.x - b.half_x, b.x + b.half_x
        if wp.static(has_lowpass_disc):
            if b.lowpass_r >= 0.0:
                low = wp.min(low, b.lowpass_x - (b.lowpass_r + PAD))
                high = wp.max(high, b.lowpass_x + (b.lowpass_r + PAD))
        left = divide(wp.max(to_sample(wp.ceil(low - 0.5), view.width), 0), view.tile_w)
        end = wp.min(to_sample(wp.floor(high - 0.5) + 1.0, view.width), view.width)
        top, bottom = tile_rows(b, view)
        return left, top, divide(end + view.tile_w - 1, view.tile_w) - left, bottom - top

    @wp.func
    def window_bits(b: Bounds, left: int, columns: int, top: int, height: int, view: View) -> wp.uint32:
        """Bits of the tiles that the bounds may overlap, in a window from column `left` and row `top` of
        tiles that contains the bounds; 0 if the window is too small.
        """
        bits = wp.uint32(0)
        if columns <= WINDOW_W and height <= WINDOW_H:
            for row in range(height):
                first, end = left, left + columns
                if height > 1:  # a single row has exactly these columns
                    first, end = tile_span(b, top + row, view)
                    # a chord between two rows of samples may be wider than the chords at the rows
                    first, end = wp.max(first, left), wp.min(end, left + columns)
                if first < end:
                    bits = bits | (ones(end - first) << wp.uint32(row * WINDOW_W + first - left))
        return bits

    @wp.func
    def touched(b: Bounds, left: int, columns: int, top: int, height: int, view: View):
        """Bits of `window_bits`, and the number of tiles that the bounds may overlap, also if they exceed the
        window."""
        bits = window_bits(b, left, columns, top, height, view)
        tiles = population(bits)
        if tiles == 0:
            for row in range(top, top + height):
                begin, end = tile_span(b, row, view)
                tiles += end - begin
        return bits, tiles

    return SimpleNamespace(
        rows=rows,
        span=span,
        tile_rows=tile_rows,
        tile_span=tile_span,
        tile_rectangle=tile_rectangle,
        touched=touched,
    )
