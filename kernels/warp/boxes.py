"""Boxes: rectangles |u| <= 1, |v| <= 1 of a splat plane with filtered edges (docs/primitives.md).
(u, v) = (n_u, n_v) / D is the intersection of a sample's ray with the plane.

D + n_u, D - n_u, D + n_v and D - n_v, divided by the lengths of their gradients, are the distances of a
sample from the four edges, inwards, in samples. For a pinhole they are affine in the sample, so each splat
has constant gradients. Behind a lens edges are curves, and gradients follow from the derivatives of each
sample's ray.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, fma
from .rays import RAY_DERIVATIVES

SQRT2 = wp.constant(wp.float32(2.0**0.5))
LINES = wp.constant(10)
"""lines that bound a box in the image: its edges, the horizon of its plane, the near plane, the image's
sides"""
ACUTE = wp.constant(0.1)
"""sine of an angle below which a corner counts as acute, as its tip may be far away"""


@wp.func
def between(d: float, n: float, edges: wp.vec2) -> float:
    """Coverage of a sample between two opposite edges; n: n_u or n_v over sqrt 2, as in a record."""
    low = wp.clamp(fma(fma(SQRT2, n, d), edges[0], 0.5), 0.0, 1.0)
    high = wp.clamp(fma(fma(-SQRT2, n, d), edges[1], 0.5), 0.0, 1.0)
    return wp.max(low + high - 1.0, 0.0)


@wp.func
def ramp(form: float, by_x: float, by_y: float) -> float:
    """Coverage of a sample on the side of an edge where its form is above 0."""
    steep = wp.sqrt(wp.max(fma(by_x, by_x, by_y * by_y), 1.0e-36))
    return wp.clamp(form / steep + 0.5, 0.0, 1.0)


@wp.func
def along_ray(form: wp.vec3, ray_derivatives: RAY_DERIVATIVES, k: int) -> float:
    """Derivative of a form, with factors of a ray's X, Y, Z, with respect to the sample's column (k = 0) or
    row (1)."""
    return fma(
        form[2], ray_derivatives[k, 2], fma(form[1], ray_derivatives[k, 1], form[0] * ray_derivatives[k, 0])
    )


@wp.func
def between_curves(
    d: float, n: float, of_d: wp.vec3, of_n: wp.vec3, ray_derivatives: RAY_DERIVATIVES
) -> float:
    """`between` behind a lens. of_d, of_n: factors of a ray's X, Y, Z in D and n. ray_derivatives:
    derivatives of the ray."""
    d_x, d_y = along_ray(of_d, ray_derivatives, 0), along_ray(of_d, ray_derivatives, 1)
    n_x, n_y = along_ray(of_n, ray_derivatives, 0), along_ray(of_n, ray_derivatives, 1)
    low = ramp(fma(SQRT2, n, d), fma(SQRT2, n_x, d_x), fma(SQRT2, n_y, d_y))
    high = ramp(fma(-SQRT2, n, d), fma(-SQRT2, n_x, d_x), fma(-SQRT2, n_y, d_y))
    return wp.max(low + high - 1.0, 0.0)


@cache
def make_boxes(real) -> SimpleNamespace:
    """Functions for boxes.

    edges: factors from the forms of a box to distances from its edges. extent, parallel: image bounds for
    pinhole and orthographic cameras. spread: a rectangle around the box, for the bounds behind a lens.
    """
    vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
    lines_type = wp.types.matrix((int(LINES), 3), real)
    zero, half, one = real(0.0), real(0.5), real(1.0)

    @wp.func
    def per_gradient(x: real, y: real) -> real:
        return one / wp.max(wp.sqrt(x * x + y * y), real(1e-30))

    @wp.func
    def edges(scale: real, d_x: real, d_y: real, n_x: real, n_y: real) -> wp.vec2:
        """Reciprocal gradient lengths of the forms D + n and D - n times `scale`."""
        return wp.vec2(
            float(per_gradient(scale * d_x + scale * n_x, scale * d_y + scale * n_y)),
            float(per_gradient(scale * d_x - scale * n_x, scale * d_y - scale * n_y)),
        )

    @wp.func
    def corners(lines: lines_type, clear: bool):
        """Box x0, x1, y0, y1 around the corners of a quadrangle with opposite sides 0, 1 and 2, 3; and
        whether no corner is acute.
        """
        box = vec4(real(wp.inf), -real(wp.inf), real(wp.inf), -real(wp.inf))
        blunt = clear
        corner_count = int(4)
        for corner in range(corner_count):
            k = corner / 2
            j = 2 + corner % 2
            turn = lines[k, 1] * lines[j, 2] - lines[k, 2] * lines[j, 1]
            if not (wp.abs(turn) > real(ACUTE)):
                blunt = False
            x = (lines[k, 2] * lines[j, 0] - lines[j, 2] * lines[k, 0]) / turn
            y = (lines[j, 1] * lines[k, 0] - lines[k, 1] * lines[j, 0]) / turn
            box = grown(box, x, y)
        return box, blunt

    @wp.func
    def grown(box: vec4, x: real, y: real) -> vec4:
        return vec4(wp.min(box[0], x), wp.max(box[1], x), wp.min(box[2], y), wp.max(box[3], y))

    @wp.func
    def rim(lines: lines_type):
        """Box around the polygon in which all forms are at least 0, from the segment of each line in it."""
        box = vec4(real(wp.inf), -real(wp.inf), real(wp.inf), -real(wp.inf))
        count = int(LINES)
        for k in range(count):
            gx, gy = lines[k, 1], lines[k, 2]
            squared = gx * gx + gy * gy
            if squared > zero:
                foot_x, foot_y = -lines[k, 0] * gx / squared, -lines[k, 0] * gy / squared
                low = -real(wp.inf)
                high = real(wp.inf)
                for j in range(count):
                    if j != k:
                        value = lines[j, 0] + lines[j, 1] * foot_x + lines[j, 2] * foot_y
                        slope = lines[j, 2] * gx - lines[j, 1] * gy
                        if slope > zero:
                            low = wp.max(low, -value / slope)
                        elif slope < zero:
                            high = wp.min(high, -value / slope)
                        elif not (value >= zero):
                            high = -real(wp.inf)
                if low <= high:
                    box = grown(box, foot_x - low * gy, foot_y + low * gx)
                    box = grown(box, foot_x - high * gy, foot_y + high * gx)
        return box

    @wp.func
    def extent(tangent_u: vec3, tangent_v: vec3, p: vec3, su: real, sv: real, clear: bool, view: View):
        """Bounds x0, x1, y0, y1 of the samples that a box may cover, up to half a sample outside of its
        edges; x0 > x1 if there are none. clear: whether the box is completely beyond the near plane.
        """
        per_fx, per_fy = real(view.per_focal_x), real(view.per_focal_y)
        cx, cy = real(view.center_x), real(view.center_y)
        normal = wp.cross(tangent_u, tangent_v)
        height = wp.dot(normal, p)
        side = wp.where(height < zero, -one, one)
        d = normal * side
        u = wp.cross(tangent_v, p) * (side / su)
        v = wp.cross(p, tangent_u) * (side / sv)
        # relative to the principal point
        lines = lines_type()
        edge_count = int(4)
        for k in range(edge_count):
            turn = wp.where(k % 2 == 0, one, -one)
            form = d + turn * wp.where(k < 2, u, v)
            x, y = form[0] * per_fx, form[1] * per_fy
            per = per_gradient(x, y)
            lines[k, 0] = form[2] * per + half
            lines[k, 1] = x * per
            lines[k, 2] = y * per
        box, blunt = corners(lines, clear)
        if not blunt:
            for k in range(2):
                turn = wp.where(k == 0, one, -one)
                lines[4 + k, 0] = turn * d[2] + wp.where(k == 0, zero, wp.abs(height) * real(view.per_near))
                lines[4 + k, 1] = turn * d[0] * per_fx
                lines[4 + k, 2] = turn * d[1] * per_fy
                lines[6 + k, 0] = one + wp.where(k == 0, cx, real(view.width) - cx)
                lines[6 + k, 1] = turn
                lines[8 + k, 0] = one + wp.where(k == 0, cy, real(view.height) - cy)
                lines[8 + k, 2] = turn
            box = rim(lines)
        return vec4(box[0] + cx, box[1] + cx, box[2] + cy, box[3] + cy)

    @wp.func
    def parallel(tangent_u: vec3, tangent_v: vec3, su: real, sv: real, x: real, y: real, view: View):
        """`extent` for parallel rays, with the projected centre (x, y): bounds of a rectangle whose sides are
        half a sample further out.
        """
        per_fx, per_fy = real(view.per_focal_x), real(view.per_focal_y)
        facing = wp.abs(tangent_u[0] * tangent_v[1] - tangent_u[1] * tangent_v[0])
        if not (facing > zero):
            return vec4(one, zero, one, zero)  # edge-on: no ray intersects it
        # metres of the plane per sample, across each pair of sides
        step_u = wp.length(vec2(tangent_v[1] * per_fx, tangent_v[0] * per_fy)) / facing
        step_v = wp.length(vec2(tangent_u[1] * per_fx, tangent_u[0] * per_fy)) / facing
        u, v = su + half * step_u, sv + half * step_v
        across = (wp.abs(tangent_u[0]) * u + wp.abs(tangent_v[0]) * v) * real(view.focal_x)
        down = (wp.abs(tangent_u[1]) * u + wp.abs(tangent_v[1]) * v) * real(view.focal_y)
        return vec4(x - across, x + across, y - down, y + down)

    @wp.func
    def spread(tangent_u: vec3, tangent_v: vec3, p: vec3, su: real, sv: real, step: real) -> vec2:
        """Half of the sides [m] of a rectangle around p that contains the intersections of the plane with the
        rays of all partly covered samples. step: maximum distance of the rays of neighbouring samples.

        For such a sample |u| <= s_u + s_u |grad F| / 2 D with F = D -+ n_u, |s_u grad F| <= (s_u + |t_v x p|)
        step and D >= |n p| / |P|, P the intersection; the same along v. |P| <= |p| + |u| + |v| then is a
        linear inequality. If it has no solution, near the plane's horizon, the rectangle is the complete
        plane.
        """
        away = wp.length(p)
        grown = half * step / wp.abs(wp.dot(wp.cross(tangent_u, tangent_v), p))
        grad_u = grown * (su + wp.length(wp.cross(tangent_v, p)))
        grad_v = grown * (sv + wp.length(wp.cross(p, tangent_u)))
        if grad_u + grad_v < real(0.9):
            furthest = (away + su + sv) / (one - grad_u - grad_v)
            return vec2(su + grad_u * furthest, sv + grad_v * furthest)
        everything = real(1e6) * (away + su + sv)
        return vec2(everything, everything)

    return SimpleNamespace(edges=edges, extent=extent, parallel=parallel, spread=spread)
