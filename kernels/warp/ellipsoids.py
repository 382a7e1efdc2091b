"""Equivalent disks of 3D Gaussians, with the same image (docs/primitives.md): exact, or EWA as in 3DGS."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .bounds import Bounds, box_bounds
from .common import View
from .fast import make_log

EXACT = "ellipsoid_exact"
EWA = ("ellipsoid_ewa", "ellipsoid_ewa_antialiased")
FACING = "ellipsoids_only"
"""effect of EWA without disks: all splats face the camera, with D = 1 and an n_u that is constant along
columns"""


@cache
def make_ellipsoids(effects: tuple[str, ...], real) -> SimpleNamespace:
    """Make functions for the equivalent disk of a 3D Gaussian.

    disk(a, b, unit_normal, sizes, p, view): its tangents. surface: its normal. rim: radius of the disk
    that bounds the ellipsoid. reach: half of the ellipsoid's depth range. clipped: bounds of an ellipsoid
    that crosses the plane of the camera.
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    zero, half, one = real(0.0), real(0.5), real(1.0)
    margin, within = (real(1e-12), real(1e-15)) if real is wp.float64 else (real(1e-4), real(1e-6))
    widening = real(0.3)
    sharp, antialiased = EXACT in effects, "ellipsoid_ewa_antialiased" in effects
    parallel = "camera_orthographic" in effects
    ln = make_log(real)
    along_ray = "camera_fisheye" in effects or "camera_equirectangular" in effects

    @wp.func
    def exact(a: vec3, b: vec3, c: vec3, sizes: vec3, towards: vec3):
        """Equivalent disk with ellipsoid="exact", from scaled axes and their lengths.

        W maps the covariance to the identity. Returns the scaled tangents of the disk whose image by W is
        perpendicular to W `towards`, its unit normal, its area, and 1 / m, infinite if the camera is at the
        centre.

        With e the longest axis and W p = (g, h) along e and across it, the tangents are the images of (h, -g)
        / m in the plane of both, and of the vector perpendicular to that plane. Neither has a difference
        along e, so that nothing cancels for needles.
        """
        e0, e1, e2 = a, b, c
        s0, s1, s2 = sizes[0], sizes[1], sizes[2]
        if s1 > s0 and s1 >= s2:
            e0, e1, e2 = b, c, a
            s0, s1, s2 = sizes[1], sizes[2], sizes[0]
        elif s2 > s0:
            e0, e1, e2 = c, a, b
            s0, s1, s2 = sizes[2], sizes[0], sizes[1]
        shortest = wp.min(s1, s2)
        # in units of the shortest axis, so that nothing overflows
        w0, w1, w2 = shortest / s0, shortest / s1, shortest / s2
        g0 = wp.dot(e0, towards) / s0 * w0
        g1, g2 = wp.dot(e1, towards) / s1 * w1, wp.dot(e2, towards) / s2 * w2
        h = wp.sqrt(g1 * g1 + g2 * g2)
        m = wp.sqrt(g0 * g0 + h * h)
        k1, k2 = one, zero
        if h > zero:
            k1 = g1 / h
            k2 = g2 / h
        inverse_m = real(wp.inf)
        u, v, unit_normal, area = a, b, c, one
        if m > zero:
            inverse_m = shortest / m
            u = e0 * (h / m) - (g0 / m) * (k1 * e1 + k2 * e2)
            v = k2 * e1 - k1 * e2
            # the inverse covariance times `towards`
            n = e0 * (g0 * w0 / s0) + e1 * (g1 * w1 / s1) + e2 * (g2 * w2 / s2)
            unit_normal = n / wp.sqrt(wp.dot(n, n))
            area = s0 * wp.max(s1, s2) * m / wp.dot(unit_normal, towards)
        return u, v, unit_normal, area, inverse_m

    @wp.func
    def image(a: vec3, b: vec3, c: vec3, p: vec3, view: View):
        """Scaled axes projected to the image: columns and rows [samples]; samples per metre at the centre;
        and slopes of the centre's ray, clamped to the limits of the Jacobian."""
        per_x, per_y = real(view.focal_x), real(view.focal_y)
        slope_x, slope_y = zero, zero
        if wp.static(not parallel):
            ahead = one / p[2]
            per_x *= ahead
            per_y *= ahead
            slope_x = wp.clamp(p[0] * ahead, -real(view.ewa_clamp[0]), real(view.ewa_clamp[1]))
            slope_y = wp.clamp(p[1] * ahead, -real(view.ewa_clamp[2]), real(view.ewa_clamp[3]))
        across = per_x * vec3(a[0] - slope_x * a[2], b[0] - slope_x * b[2], c[0] - slope_x * c[2])
        down = per_y * vec3(a[1] - slope_y * a[2], b[1] - slope_y * b[2], c[1] - slope_y * c[2])
        return across, down, vec4(per_x, per_y, slope_x, slope_y)

    @wp.func
    def widened(across: vec3, down: vec3, view: View):
        """Cholesky factor of the widened covariance on the image; determinants before and after."""
        spread = widening / real(view.sample_area)
        xx, xy, yy = wp.dot(across, across), wp.dot(across, down), wp.dot(down, down)
        crossed = wp.cross(across, down)  # so that the determinant does not cancel
        before = wp.dot(crossed, crossed)
        after = before + spread * (xx + yy + spread)
        l11 = wp.sqrt(xx + spread)
        return vec3(l11, xy / l11, wp.sqrt(after) / l11), before, after

    @wp.func
    def ewa(a: vec3, b: vec3, c: vec3, p: vec3, view: View):
        """Equivalent disk with ellipsoid="ewa", from scaled axes: Cholesky factor of a disk that faces the
        camera and has the widened image, and the determinants of the covariance before and after."""
        across, down, per = image(a, b, c, p, view)
        factor, before, after = widened(across, down, view)
        return vec3(factor[0] / per[0], factor[1] / per[1], factor[2] / per[1]), before, after

    @wp.func
    def disk(a: vec3, b: vec3, unit_normal: vec3, sizes: vec3, p: vec3, view: View):
        """Equivalent disk, from scaled tangents, unit normal and three standard deviations.

        Returns its scaled tangents and unit normal, the distance of its plane, the semi-axis conjugate to the
        tangents, 1 / m^2, two factors of its area, and the term of ln(opacity), -inf for a culled splat.
        """
        c = unit_normal * sizes[2]
        u, v, normal, offset, third = a, b, unit_normal, zero, vec3()
        inverse_m2, su, sv, log_compensation = zero, one, one, -real(wp.inf)
        if wp.static(sharp):
            towards = p
            if wp.static(parallel):
                towards = vec3(zero, zero, one)
            u, v, normal, su, inverse_m = exact(a, b, c, sizes, towards)
            if inverse_m < real(
                wp.inf
            ):  # infinite if the camera is at the centre, where no ray has a maximum ahead
                log_compensation = zero
                offset = wp.dot(normal, towards)
                third = towards * inverse_m
                if wp.static(not parallel):
                    inverse_m2 = inverse_m * inverse_m
        else:
            if p[2] >= real(view.near):
                axes, before, after = ewa(a, b, c, p, view)
                u, v = vec3(axes[0], axes[1], zero), vec3(zero, axes[2], zero)
                normal, offset = vec3(zero, zero, one), p[2]
                if wp.static(parallel):
                    offset = one
                su, sv = axes[0], axes[2]
                log_compensation = zero
                if wp.static(antialiased):
                    log_compensation = half * ln(before / after)
        return u, v, normal, offset, third, inverse_m2, su, sv, log_compensation

    @wp.func
    def surface(tangent_u: vec3, tangent_v: vec3, tangent_w: vec3, sizes: vec3, p: vec3) -> vec3:
        """Unit normal of the surface of maxima along rays, at the centre, away from the camera: the inverse
        covariance times the ray, in units of the shortest axis."""
        towards = p
        if wp.static(parallel):
            towards = vec3(zero, zero, one)
        shortest = wp.min(wp.min(sizes[0], sizes[1]), sizes[2])
        u, v, w = shortest / sizes[0], shortest / sizes[1], shortest / sizes[2]
        outward = wp.dot(tangent_u, towards) * u * u * tangent_u
        outward += wp.dot(tangent_v, towards) * v * v * tangent_v
        outward += wp.dot(tangent_w, towards) * w * w * tangent_w
        return outward / wp.sqrt(wp.dot(outward, outward))

    @wp.func
    def rim(radius: real, inverse_m2: real) -> real:
        """Radius of the disk that the cone around the ellipsoid touches; large if the camera is inside of the
        ellipsoid, where all rays ahead may intersect it."""
        return radius / wp.sqrt(wp.max(one - radius * radius * inverse_m2 - within, real(1e-12)))

    @wp.func
    def reach(a: vec3, b: vec3, third: vec3, radius: real) -> real:
        """Half of the ellipsoid's depth range; for fisheyes and panoramas, a bound of its distance range."""
        if wp.static(along_ray):
            return radius * wp.sqrt(wp.dot(a, a) + wp.dot(b, b) + wp.dot(third, third))
        else:
            return radius * wp.sqrt(a[2] * a[2] + b[2] * b[2] + third[2] * third[2])

    @wp.func
    def clipped(box: Bounds, a: vec3, b: vec3, p: vec3, third: vec3, inverse_m2: real, view: View) -> Bounds:
        """Image bounds of an ellipsoid clipped at the near plane, for a pinhole.

        The maxima along rays are on a similar ellipsoid whose diameter is the segment from the camera to the
        centre. The maxima beyond `near` project into the section of that ellipsoid at `near`.
        """
        near = real(view.near)
        x, y, z = vec3(a[0], b[0], third[0]), vec3(a[1], b[1], third[1]), vec3(a[2], b[2], third[2])
        zz, ahead = wp.dot(z, z), near - half * p[2]
        squared = half * half / inverse_m2 * (one + margin) - ahead * ahead / zz
        if not (squared > zero):
            return box_bounds(1.0, 0.0, 1.0, 0.0)
        reach_x = wp.length(wp.cross(x, z)) * wp.sqrt(squared / zz)
        reach_y = wp.length(wp.cross(y, z)) * wp.sqrt(squared / zz)
        middle_x, middle_y = half * p[0] + wp.dot(x, z) / zz * ahead, half * p[1] + wp.dot(y, z) / zz * ahead
        fx, fy = real(view.focal_x) / near, real(view.focal_y) / near
        cx, cy = real(view.center_x), real(view.center_y)
        return box_bounds(
            wp.max(box.x - box.half_x, float(fx * (middle_x - reach_x) + cx)),
            wp.min(box.x + box.half_x, float(fx * (middle_x + reach_x) + cx)),
            wp.max(box.y - box.half_y, float(fy * (middle_y - reach_y) + cy)),
            wp.min(box.y + box.half_y, float(fy * (middle_y + reach_y) + cy)),
        )

    return SimpleNamespace(
        disk=disk, image=image, widened=widened, surface=surface, rim=rim, reach=reach, clipped=clipped
    )
