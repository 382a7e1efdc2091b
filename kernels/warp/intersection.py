"""Intersection of a sample's ray with a splat, and the alpha and depth of the fragment."""

import math
from functools import cache
from types import SimpleNamespace

import warp as wp

from .boxes import between, between_curves
from .common import View, fma, load_vec4, struct_of
from .ellipsoids import EXACT, FACING
from .fast import fast_exp
from .rays import RAY_DERIVATIVES
from .records import BOXES, RecordLayout
from .splat import make_splat

HALF_RHO_OF_RANGE = wp.constant(wp.float32(math.log(255.0)))
"""half of the rho at which a splat has 1/255 of its opacity"""


@cache
def make_intersection(effects: tuple[str, ...], outputs: tuple[str, ...]) -> SimpleNamespace:
    """Make the struct Intersection and functions column, cross, intersect_ray, intersect_derivatives (None
    without boxes behind a lens), is_box, alpha_of and depth_of.
    """
    Splat = make_splat(effects, outputs).Splat
    layout = RecordLayout(effects, outputs)
    stride = layout.vec4s
    has_lowpass_disc, has_lens, parallel, all_boxes = (
        name in effects for name in ("lowpass_screen", "rays", "camera_orthographic", "footprint_box")
    )
    thick, facing = EXACT in effects, FACING in effects and not parallel
    boxes = any(name in effects for name in BOXES)
    curved, edged = (
        boxes and has_lens,
        boxes and not has_lens,
    )  # edges from each sample's ray, or from a record
    exp = fast_exp if "arithmetic_fast" in effects else wp.exp
    # q / d^2 is rho / 2; inside: the ray intersects the disk within R and beyond the near plane
    fields = {"d": wp.float32, "q": wp.float32, "inside": wp.bool, "contributes": wp.bool}
    # lowpass_half_rho: squared distance from the projected centre in pixels, rho / 2 of the low-pass
    fields |= {"lowpass_half_rho": wp.float32} if has_lowpass_disc else {}
    fields |= {"z": wp.float32} if parallel else {}  # d times the depth
    # cover: coverage of the sample by a box
    fields |= {"cover": wp.float32} if boxes else {}
    Intersection = struct_of("Intersection", "Where the ray of a sample meets a splat.", fields)
    z_vec4, z_component = layout.position("z_numerator")
    zc_vec4, zc_component = layout.position("z_center")
    zr_vec4, zr_component = layout.position("z_reach")

    @wp.func
    def column(form: wp.vec4, x: float) -> float:
        """The part of an affine form that is constant along a column of samples."""
        return fma(form[1], x, form[0])

    @wp.func
    def is_box(s: Splat) -> bool:
        if wp.static(all_boxes):
            return True
        elif wp.static(curved):
            return s.boxed > 0.0
        else:
            return s.edges[0] > 0.0

    @wp.func
    def cross(s: Splat, column_u: float, column_v: float, column_d: float, x: float, y: float, view: View):
        """Intersection of a pinhole ray with a splat.

        x, y: the sample, relative to the splat's anchor. column_*: `column` of the affine forms n_u, n_v and
        D at x.
        """
        if wp.static(facing):
            # bit-identical to the general case
            c, nv = Intersection(), fma(s.v[2], y, column_v)
            c.d = 1.0
            c.q = fma(column_u, column_u, nv * nv)
            c.inside = c.q <= s.half_r2
            c.contributes = c.inside
            return c
        else:
            nu, nv, d = fma(s.u[2], y, column_u), fma(s.v[2], y, column_v), fma(s.d[2], y, column_d)
            return meet(s, nu, nv, d, x, y, view)

    @wp.func
    def forms_of(s: Splat, ray: wp.vec3) -> wp.vec3:
        """The forms n_u, n_v and D of a ray."""
        r = ray - s.origin
        return wp.vec3(
            fma(s.w[0], r[2], fma(s.u[2], r[1], fma(s.u[1], r[0], s.u[0]))),
            fma(s.w[1], r[2], fma(s.v[2], r[1], fma(s.v[1], r[0], s.v[0]))),
            fma(s.w[2], r[2], fma(s.d[2], r[1], fma(s.d[1], r[0], s.d[0]))),
        )

    @wp.func
    def intersect_ray(s: Splat, ray: wp.vec3, x: float, y: float, view: View):
        """Intersection of any ray with a splat. x, y: its sample, relative to the splat's anchor."""
        n = forms_of(s, ray)
        c = meet(s, n[0], n[1], n[2], x, y, view)
        c.contributes = c.contributes and n[2] == n[2]  # NaN: the sample has no ray
        return c

    @wp.func
    def intersect_derivatives(
        s: Splat, ray: wp.vec3, ray_derivatives: RAY_DERIVATIVES, x: float, y: float, view: View
    ):
        """Intersection of a ray with a splat or a box. ray_derivatives: for edges of boxes."""
        c = intersect_ray(s, ray, x, y, view)
        if is_box(s):
            n, of_d = forms_of(s, ray), wp.vec3(s.d[1], s.d[2], s.w[2])
            across = between_curves(n[2], n[0], of_d, wp.vec3(s.u[1], s.u[2], s.w[0]), ray_derivatives)
            c.cover = across * between_curves(
                n[2], n[1], of_d, wp.vec3(s.v[1], s.v[2], s.w[1]), ray_derivatives
            )
            c.inside = c.cover > 0.0 and c.d > 0.0 and c.d <= s.v[3]
            c.contributes = c.inside
        return c

    @wp.func
    def meet(s: Splat, nu: float, nv: float, d: float, x: float, y: float, view: View):
        c = Intersection()
        c.d = d
        ahead = c.d > 0.0 and c.d <= s.v[3]
        if wp.static(parallel):
            c.z = fma(s.plane[2], y, fma(s.plane[1], x, s.plane[0]))
            ahead = ahead and c.z >= s.plane[3] * c.d
        if wp.static(not all_boxes):
            c.q = fma(nu, nu, nv * nv)
            # product form: no division, no special value of D
            c.inside = c.q <= s.half_r2 * (c.d * c.d) and ahead
        if wp.static(thick):
            if s.ellipsoid_term > 0.0:
                squared = fma(s.ellipsoid_term, c.q, c.d * c.d)  # D^2 (1 + rho of the disk / m^2)
                c.inside = c.q <= s.half_r2 * squared and c.d > 0.0 and squared <= s.v[3] * c.d
                # as for a disk: rho / 2 is q / d^2, and depth is proportional to 1 / d
                inverse = 1.0 / c.d
                c.d = squared * inverse
                c.q = c.q * c.d * inverse
        if wp.static(edged):
            if is_box(s):
                across = between(c.d, nu, wp.vec2(s.edges[0], s.edges[1]))
                c.cover = across * between(c.d, nv, wp.vec2(s.edges[2], s.edges[3]))
                c.inside = c.cover > 0.0 and ahead
        c.contributes = c.inside
        if wp.static(has_lowpass_disc):
            ex = x - s.lowpass_x
            ey = y - s.lowpass_y
            c.lowpass_half_rho = fma(ex, ex, ey * ey) * view.sample_area
            c.contributes = c.inside or c.lowpass_half_rho <= s.half_r2
        return c

    @wp.func
    def alpha_of(s: Splat, c: Intersection, inverse_d: float, view: View) -> float:
        if wp.static(boxes):
            if is_box(s):
                return wp.min(exp(s.u[3]), view.opacity_ceiling) * c.cover
        half_rho = c.q * inverse_d * inverse_d
        if wp.static(has_lowpass_disc):
            if c.inside:
                half_rho = wp.min(half_rho, c.lowpass_half_rho)
            else:
                half_rho = c.lowpass_half_rho
        return wp.min(exp(s.u[3] - half_rho), view.opacity_ceiling)

    @wp.func
    def depth_of(
        records: wp.array(dtype=wp.vec4),
        index: int,
        s: Splat,
        c: Intersection,
        inverse_d: float,
        coplanar: bool,
    ) -> float:
        """Depth of the ray-plane intersection, clamped to the splat's depth range; the centre's depth if the
        ray does not intersect the plane beyond `near`.

        Outside of the circle rho = max(2 ln 255, rho of the low-pass disc) the intersection is reflected at
        the circle: the difference from the centre's depth is multiplied by the ratio of their rho. coplanar:
        whether the splat is in a coplanar group, whose depths are not reflected.
        """
        at = index * stride
        center = load_vec4(records, at + zc_vec4)[zc_component]
        reach = load_vec4(records, at + zr_vec4)[zr_component]
        if not (c.d > 0.0):
            return center
        depth_d, beyond_near = float(0.0), bool(False)  # depth times D
        if wp.static(parallel):
            depth_d = c.z
            beyond_near = c.z >= s.plane[3] * c.d
        else:
            depth_d = load_vec4(records, at + z_vec4)[z_component]
            beyond_near = c.d <= s.v[3]
        depth = depth_d * inverse_d
        if wp.static(has_lowpass_disc):
            if not beyond_near:
                return center
            circle = wp.max(c.lowpass_half_rho, HALF_RHO_OF_RANGE)
            if not (coplanar or c.q * inverse_d * inverse_d <= circle):
                depth = fma(circle * (depth_d - center * c.d), c.d / c.q, center)
        return wp.clamp(depth, center - reach, center + reach)

    return SimpleNamespace(
        Intersection=Intersection,
        column=column,
        cross=cross,
        intersect_ray=intersect_ray,
        intersect_derivatives=intersect_derivatives if curved else None,
        is_box=is_box,
        facing=facing,
        alpha_of=alpha_of,
        depth_of=depth_of,
    )
