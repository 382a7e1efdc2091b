"""One sample: its fragments, and what it keeps of them. Front to back, C = sum_k c_k alpha_k prod_{j<k} (1 - alpha_j)."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, fma, line_of
from .records import Layout

_STATE = {
    "stop_exclusive": {"finished": wp.int32},
    "depth": {"depth": wp.float32, "depth_weight": wp.float32},
    "depth_median": {"depth_median": wp.float32},
    "normal": {"normal": wp.vec3},
    "label": {"label_weight": wp.float32, "label": wp.int32},
}


@wp.struct
class Crossing:
    """Where the ray of a sample meets a splat."""

    d: float
    q: float  # n_u^2 + n_v^2: rho / 2 is q / d^2
    screen: float  # squared distance from the projected centre in pixels, which is rho / 2 of the low-pass
    inside: bool  # the ray meets the disk within R and beyond the near plane
    drawn: bool


@cache
def make_pixel(effects: tuple[str, ...]) -> SimpleNamespace:
    """The state of a sample and what is done with it: Pixel, Splat, load, start, cross, open, blend; Splat is what of a record each
    sample needs.
    """
    layout = Layout(effects)
    each = layout.lines
    screen, exclusive, ray_depth, depth, median, normal, label = (
        name in effects
        for name in ("lowpass_screen", "stop_exclusive", "ray_depth", "depth", "depth_median", "normal", "label")
    )
    fields = {"t": wp.float32, "r": wp.float32, "g": wp.float32, "b": wp.float32}
    for effect in effects:
        fields |= _STATE.get(effect, {})
    Pixel = wp.struct(type("Pixel", (), {"__annotations__": fields, "__doc__": "What a sample keeps.", "__module__": __name__}))
    dot_line, dot_lane = layout.place("dot_x")
    dot_y_line, dot_y_lane = layout.place("dot_y")
    z_line, z_lane = layout.place("z_numerator")
    zc_line, zc_lane = layout.place("z_center")
    zr_line, zr_lane = layout.place("z_reach")
    nx_line, nx_lane = layout.place("nx")
    ny_line, ny_lane = layout.place("ny")
    nz_line, nz_lane = layout.place("nz")

    @wp.struct
    class Splat:
        u: wp.vec4  # nu0, nux, nuy, log opacity
        v: wp.vec4  # nv0, nvx, nvy, D at the near plane
        d: wp.vec4  # d0, dx, dy, ax
        c: wp.vec4  # ay, r, g, b
        dot_x: float
        dot_y: float
        half_r2: float

    @wp.func
    def load(lines: wp.array(dtype=wp.vec4), index: int, view: View):
        s = Splat()
        at = index * each
        s.u = line_of(lines, at)
        s.v = line_of(lines, at + 1)
        s.d = line_of(lines, at + 2)
        s.c = line_of(lines, at + 3)
        if wp.static(screen):
            s.dot_x = line_of(lines, at + dot_line)[dot_lane]
            s.dot_y = line_of(lines, at + dot_y_line)[dot_y_lane]
        s.half_r2 = s.u[3] - view.log_cut
        return s

    @wp.func
    def start():
        p = Pixel()
        p.t = 1.0
        if wp.static(label):
            p.label = -1
        return p

    @wp.func
    def row(form: wp.vec4, y: float) -> float:
        """The part of an affine form that does not change along a row of samples."""
        return fma(form[2], y, form[0])

    @wp.func
    def cross(s: Splat, row_u: float, row_v: float, row_d: float, x: float, y: float, view: View):
        """x, y: the sample from the anchor; row_*: `row` of the three forms at y."""
        c = Crossing()
        nu = fma(s.u[1], x, row_u)
        nv = fma(s.v[1], x, row_v)
        c.d = fma(s.d[1], x, row_d)
        c.q = fma(nu, nu, nv * nv)
        # product form: no division, no special value of D (numerics B2)
        c.inside = c.q <= s.half_r2 * (c.d * c.d) and c.d > 0.0 and c.d <= s.v[3]
        c.drawn = c.inside
        if wp.static(screen):
            ex = x - s.dot_x
            ey = y - s.dot_y
            c.screen = fma(ex, ex, ey * ey) * view.per_pixel
            c.drawn = c.inside or c.screen <= s.half_r2
        return c

    @wp.func
    def unfinished(p: Pixel, view: View) -> bool:
        """Whether anything that follows can still be seen."""
        if wp.static(exclusive):
            return p.t > view.stop and p.finished == 0
        return p.t > view.stop

    @wp.func
    def opacity_of(s: Splat, c: Crossing, inverse_d: float, view: View) -> float:
        half_rho = c.screen
        if c.inside:
            half_rho = c.q * inverse_d * inverse_d
            if wp.static(screen):
                half_rho = wp.min(half_rho, c.screen)
        return wp.min(wp.exp(s.u[3] - half_rho), view.ceiling)

    @wp.func
    def depth_of(lines: wp.array(dtype=wp.vec4), index: int, c: Crossing, inverse_d: float) -> float:
        """Depth of ray and plane within the disk's own range; the centre's where the ray misses the plane (numerics B2, B4)."""
        at = index * each
        center = line_of(lines, at + zc_line)[zc_lane]
        reach = line_of(lines, at + zr_line)[zr_lane]
        if c.d > 0.0:
            met = line_of(lines, at + z_line)[z_lane] * inverse_d
            return wp.clamp(met, center - reach, center + reach)
        return center

    @wp.func
    def normal_of(lines: wp.array(dtype=wp.vec4), index: int):
        at = index * each
        return wp.vec3(
            line_of(lines, at + nx_line)[nx_lane], line_of(lines, at + ny_line)[ny_lane], line_of(lines, at + nz_line)[nz_lane]
        )

    @wp.func
    def blend(
        pixel: Pixel,
        s: Splat,
        c: Crossing,
        index: int,
        lines: wp.array(dtype=wp.vec4),
        labels: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel after a fragment that is drawn, of a splat whose pixel is not finished."""
        p = pixel
        inverse_d = 1.0 / c.d
        opacity = opacity_of(s, c, inverse_d, view)
        if wp.static(exclusive):
            # as gsplat and the 2DGS authors: what would close the pixel is dropped (for parity; numerics D1)
            if p.t * (1.0 - opacity) <= view.stop:
                p.finished = 1
                return p
        weight = p.t * opacity
        p.r = fma(weight, s.c[1], p.r)
        p.g = fma(weight, s.c[2], p.g)
        p.b = fma(weight, s.c[3], p.b)
        if wp.static(ray_depth):
            z = depth_of(lines, index, c, inverse_d)
            if wp.static(depth):
                p.depth = fma(weight, z, p.depth)
                p.depth_weight += weight
            if wp.static(median):
                if p.t > 0.5:
                    p.depth_median = z
        if wp.static(normal):
            p.normal += weight * normal_of(lines, index)
        if wp.static(label):
            if weight > p.label_weight:
                p.label_weight = weight
                p.label = labels[index]
        p.t = p.t - weight
        return p

    return SimpleNamespace(
        Pixel=Pixel, Splat=Splat, load=load, start=start, row=row, cross=cross, unfinished=unfinished, blend=blend
    )
