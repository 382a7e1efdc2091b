"""One sample: its fragments, and what it keeps of them. Front to back, C = sum_k c_k alpha_k prod_{j<k} (1 -
alpha_j).

Splats of one plane are laid together (layers.py).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .boxes import between, between_curves
from .common import View, fma, line_of, struct_of
from .fast import fast_exp
from .layers import make_layer, make_laying
from .lens import SLOPES
from .records import BOXES, Layout
from .sight import make_sight
from .splat import make_splat

_STATE = {
    "stop_exclusive": {"finished": wp.int32},
    "depth": {"depth": wp.float32, "depth_weight": wp.float32},
    # median_light: left behind the fragment that counted last
    "depth_median": {"depth_median": wp.float32, "median_light": wp.float32},
    "depth_first": {"depth_first": wp.float32},
    "normal": {"normal": wp.vec3},
    "heaviest": {"weight": wp.float32, "heaviest": wp.int32},
    "blended": {"blended": wp.int32},
    # fog_slope: -density, per metre of depth; fogged: sum of weights times what the fog hides
    "fog": {"fog_slope": wp.float32, "fogged": wp.float32},
}
LEAST_ALPHA = wp.constant(wp.float32(1.0 / 255.0))
"""less of a sample than this is nothing to label, depth, median depth and normal"""


@cache
def make_pixel(effects: tuple[str, ...]) -> SimpleNamespace:
    """The state of a sample, and what is done with it: Rays, Pixel; start, row, cross, cross_ray,
    cross_slopes, unfinished, blend, finish.
    """
    Splat = make_splat(effects).Splat
    layout = Layout(effects)
    each = layout.lines
    screen, exclusive, ray_depth, layers = (
        name in effects for name in ("lowpass_screen", "stop_exclusive", "ray_depth", "compose_planes")
    )
    depth, median, first, normal, heaviest, blended, fog = (
        name in effects
        for name in ("depth", "depth_median", "depth_first", "normal", "heaviest", "blended", "fog")
    )
    exp = fast_exp if "arithmetic_fast" in effects else wp.exp
    bent, parallel = "rays" in effects, "camera_orthographic" in effects
    boxes, all_boxes = any(name in effects for name in BOXES), "footprint_box" in effects
    sight = make_sight(bent, "rays_length" in effects, bent and boxes)
    Rays, length_of = sight.Rays, sight.length_of
    curved, edged = boxes and bent, boxes and not bent  # their edges: from each sample's ray, from a record
    # q / d^2 is rho / 2; inside: the ray meets the disk within R and beyond the near plane
    crossing = {"d": wp.float32, "q": wp.float32, "inside": wp.bool, "drawn": wp.bool}
    # screen: squared distance from the projected centre in pixels, which is rho / 2 of the low-pass
    crossing |= {"screen": wp.float32} if screen else {}
    crossing |= {"z": wp.float32} if parallel else {}  # d times the depth
    # cover: share of the sample that a box covers
    crossing |= {"cover": wp.float32} if boxes else {}
    Crossing = struct_of("Crossing", "Where the ray of a sample meets a splat.", crossing)
    seen = {"rgb": wp.vec3}
    seen |= {"z": wp.float32} if ray_depth else {}
    seen |= {"normal": wp.vec3} if normal else {}
    # index of the splat, a layer's of the one of greatest optical depth; number of splats
    seen |= {"heaviest": wp.int32} if heaviest else {}
    seen |= {"blended": wp.int32} if blended else {}
    Seen = struct_of("Seen", "What shows where something is drawn.", seen)
    fields = {"t": wp.float32, "r": wp.float32, "g": wp.float32, "b": wp.float32}
    for effect in effects:
        fields |= _STATE.get(effect, {})
    layer = make_layer(Seen, effects) if layers else None
    # pending: the layer that still gathers, and one that arrived before it
    fields |= {"open": layer.Layer, "waiting": layer.Layer} if layer else {}
    Pixel = struct_of("Pixel", "What a sample keeps.", fields)
    z_line, z_lane = layout.place("z_numerator")
    zc_line, zc_lane = layout.place("z_center")
    zr_line, zr_lane = layout.place("z_reach")
    nx_line, nx_lane = layout.place("nx")
    ny_line, ny_lane = layout.place("ny")
    nz_line, nz_lane = layout.place("nz")

    @wp.func
    def start(x: int, y: int, rays: Rays, view: View):
        """The state of a sample before anything is drawn."""
        p = Pixel()
        p.t = 1.0
        if wp.static(median):
            p.median_light = 1.0
        if wp.static(heaviest):
            p.heaviest = -1
        if wp.static(layers):
            p.open.plane = -1
            p.waiting.plane = -1
        if wp.static(fog):
            p.fog_slope = -view.fog_density * length_of(x, y, rays, view)
        return p

    @wp.func
    def row(form: wp.vec4, y: float) -> float:
        """The part of an affine form that does not change along a row of samples."""
        return fma(form[2], y, form[0])

    @wp.func
    def is_box(s: Splat) -> bool:
        if wp.static(all_boxes):
            return True
        elif wp.static(curved):
            return s.boxed > 0.0
        else:
            return s.edges[0] > 0.0

    @wp.func
    def cross(s: Splat, row_u: float, row_v: float, row_d: float, x: float, y: float, view: View):
        """x, y: the sample from the anchor; row_*: `row` of the three forms at y."""
        return meet(s, fma(s.u[1], x, row_u), fma(s.v[1], x, row_v), fma(s.d[1], x, row_d), x, y, view)

    @wp.func
    def forms_of(s: Splat, ray: wp.vec3) -> wp.vec3:
        """n_u, n_v and D of a ray."""
        r = ray - s.origin
        return wp.vec3(
            fma(s.w[0], r[2], fma(s.u[1], r[0], fma(s.u[2], r[1], s.u[0]))),
            fma(s.w[1], r[2], fma(s.v[1], r[0], fma(s.v[2], r[1], s.v[0]))),
            fma(s.w[2], r[2], fma(s.d[1], r[0], fma(s.d[2], r[1], s.d[0]))),
        )

    @wp.func
    def cross_ray(s: Splat, ray: wp.vec3, x: float, y: float, view: View):
        """The same for the sample that has this ray."""
        n = forms_of(s, ray)
        c = meet(s, n[0], n[1], n[2], x, y, view)
        c.drawn = c.drawn and n[2] == n[2]  # nothing is seen without a ray
        return c

    @wp.func
    def cross_slopes(s: Splat, ray: wp.vec3, slopes: SLOPES, x: float, y: float, view: View):
        """The same where there are boxes, with the ray's derivatives."""
        c = cross_ray(s, ray, x, y, view)
        if is_box(s):
            n, of_d = forms_of(s, ray), wp.vec3(s.d[1], s.d[2], s.w[2])
            across = between_curves(n[2], n[0], of_d, wp.vec3(s.u[1], s.u[2], s.w[0]), slopes)
            c.cover = across * between_curves(n[2], n[1], of_d, wp.vec3(s.v[1], s.v[2], s.w[1]), slopes)
            c.inside = c.cover > 0.0 and c.d > 0.0 and c.d <= s.v[3]
            c.drawn = c.inside
        return c

    @wp.func
    def meet(s: Splat, nu: float, nv: float, d: float, x: float, y: float, view: View):
        c = Crossing()
        c.d = d
        ahead = c.d > 0.0 and c.d <= s.v[3]
        if wp.static(parallel):
            c.z = fma(s.plane[2], y, fma(s.plane[1], x, s.plane[0]))
            ahead = ahead and c.z >= s.plane[3] * c.d
        if wp.static(not all_boxes):
            c.q = fma(nu, nu, nv * nv)
            # product form: no division, no special value of D (numerics B2)
            c.inside = c.q <= s.half_r2 * (c.d * c.d) and ahead
        if wp.static(edged):
            if is_box(s):
                across = between(c.d, nu, wp.vec2(s.edges[0], s.edges[1]))
                c.cover = across * between(c.d, nv, wp.vec2(s.edges[2], s.edges[3]))
                c.inside = c.cover > 0.0 and ahead
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
        if wp.static(boxes):
            if is_box(s):
                return wp.min(wp.exp(s.u[3]), view.ceiling) * c.cover
        half_rho = c.q * inverse_d * inverse_d
        if wp.static(screen):
            if c.inside:
                half_rho = wp.min(half_rho, c.screen)
            else:
                half_rho = c.screen
        return wp.min(exp(s.u[3] - half_rho), view.ceiling)

    @wp.func
    def depth_of(lines: wp.array(dtype=wp.vec4), index: int, c: Crossing, inverse_d: float) -> float:
        """Depth of ray and plane within the disk's own range; the centre's where the ray misses the plane
        (numerics B2, B4).
        """
        at = index * each
        center = line_of(lines, at + zc_line)[zc_lane]
        reach = line_of(lines, at + zr_line)[zr_lane]
        if c.d > 0.0:
            if wp.static(parallel):
                return wp.clamp(c.z * inverse_d, center - reach, center + reach)
            met = line_of(lines, at + z_line)[z_lane] * inverse_d
            return wp.clamp(met, center - reach, center + reach)
        return center

    @wp.func
    def normal_of(lines: wp.array(dtype=wp.vec4), index: int):
        at = index * each
        return wp.vec3(
            line_of(lines, at + nx_line)[nx_lane],
            line_of(lines, at + ny_line)[ny_lane],
            line_of(lines, at + nz_line)[nz_lane],
        )

    @wp.func
    def see(
        s: Splat,
        c: Crossing,
        inverse_d: float,
        index: int,
        lines: wp.array(dtype=wp.vec4),
    ):
        """What a fragment shows."""
        seen = Seen()
        seen.rgb = wp.vec3(s.c[1], s.c[2], s.c[3])
        if wp.static(ray_depth):
            seen.z = depth_of(lines, index, c, inverse_d)
        if wp.static(normal):
            seen.normal = normal_of(lines, index)
        if wp.static(heaviest):
            seen.heaviest = index
        if wp.static(blended):
            seen.blended = 1
        return seen

    @wp.func
    def lay(pixel: Pixel, seen: Seen, opacity: float, view: View):
        """The pixel with something over all that follows; as it was if it lets no light through."""
        p = pixel
        if not (p.t > view.stop):
            return p
        if wp.static(exclusive):
            # as gsplat and the 2DGS authors: what would close the pixel is dropped (for parity; numerics D1)
            if p.t * (1.0 - opacity) <= view.stop:
                p.finished = 1
                return p
        weight = p.t * opacity
        shown = weight
        if wp.static(fog):
            shown = weight * wp.exp(p.fog_slope * seen.z)
            p.fogged += weight - shown
        p.r = fma(shown, seen.rgb[0], p.r)
        p.g = fma(shown, seen.rgb[1], p.g)
        p.b = fma(shown, seen.rgb[2], p.b)
        if wp.static(depth):
            p.depth = fma(weight, seen.z, p.depth)
            p.depth_weight += weight
        if wp.static(median):
            # faint ones count together
            if p.t > 0.5 and p.median_light - (p.t - weight) >= LEAST_ALPHA:
                p.depth_median = seen.z
                p.median_light = p.t - weight
        if wp.static(first):
            if p.depth_first == 0.0 and p.t - weight <= view.first_light:
                p.depth_first = seen.z
        if wp.static(normal):
            p.normal += weight * seen.normal
        if wp.static(heaviest):
            if weight > p.weight:
                p.weight = weight
                p.heaviest = seen.heaviest
        if wp.static(blended):
            p.blended += seen.blended
        p.t = p.t - weight
        return p

    gathered = make_laying(layer, Pixel, lay) if layer else None

    @wp.func
    def blend(
        pixel: Pixel,
        s: Splat,
        c: Crossing,
        index: int,
        lines: wp.array(dtype=wp.vec4),
        planes: wp.array(dtype=wp.int32),
        view: View,
    ):
        """The pixel after a fragment that is drawn, of a pixel that is not finished."""
        inverse_d = 1.0 / c.d
        opacity = opacity_of(s, c, inverse_d, view)
        seen = see(s, c, inverse_d, index, lines)
        if wp.static(layers):
            p = pixel
            if not (opacity > 0.0):
                return p  # of no optical depth: a mean over it would be 0 / 0
            plane = planes[index]
            if plane < 0:
                p = gathered.lay_before(p, seen.z, view)
                return lay(p, seen, opacity, view)
            if p.open.plane >= 0 and p.open.plane != plane:
                p = gathered.begin(p, view)
            if wp.static(boxes):
                if is_box(s):
                    p.open = layer.gather_box(p.open, plane, seen, opacity)
                    return p
            p.open = layer.gather(p.open, plane, seen, opacity)
            return p
        else:
            return lay(pixel, seen, opacity, view)

    @wp.func
    def finish(pixel: Pixel, view: View):
        """The pixel after the last fragment."""
        p = pixel
        if wp.static(layers):
            p = gathered.lay_before(p, float(wp.inf), view)
        if 1.0 - p.t < LEAST_ALPHA:
            if wp.static(depth):
                p.depth = 0.0
                p.depth_weight = 0.0
            if wp.static(normal):
                p.normal = wp.vec3()
            if wp.static(heaviest):
                p.weight = 0.0
        return p

    return SimpleNamespace(
        Rays=Rays,
        Pixel=Pixel,
        start=start,
        row=row,
        cross=cross,
        cross_ray=cross_ray,
        cross_slopes=cross_slopes if curved else None,
        unfinished=unfinished,
        blend=blend,
        finish=finish,
    )
