"""Equivalent disks of 3D Gaussians, with the same image (docs/primitives.md): exact, or EWA as in 3DGS."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .bounds import Bounds, box_bounds
from .common import View

EXACT = "ellipsoid_exact"
EWA = ("ellipsoid_ewa", "ellipsoid_ewa_antialiased")


@cache
def make_ellipsoids(effects: tuple[str, ...], real) -> SimpleNamespace:
    """Functions for the equivalent disk of a 3D Gaussian.

    disk(tangent_u, tangent_v, sizes, p, view): its tangents. surface: its normal. rim: radius of the disk
    that bounds the ellipsoid. reach: half of the ellipsoid's depth range. clipped: bounds of an ellipsoid
    that crosses the plane of the camera.
    """
    vec3 = wp.types.vector(3, real)
    zero, half, one = real(0.0), real(0.5), real(1.0)
    margin, within = (real(1e-12), real(1e-15)) if real is wp.float64 else (real(1e-4), real(1e-6))
    widening = real(0.3)
    sharp, antialiased = EXACT in effects, "ellipsoid_ewa_antialiased" in effects
    parallel = "camera_orthographic" in effects
    along_ray = "camera_fisheye" in effects or "camera_equirectangular" in effects

    @wp.func
    def exact(u: vec3, v: vec3, w: vec3, sizes: vec3, towards: vec3):
        """Equivalent disk with ellipsoid="exact", from unit axes and standard deviations.

        W maps the covariance to the identity. Returns the scaled tangents of the disk that is perpendicular
        to W `towards` there, its area, and 1 / m, infinite if the camera is at the centre.

        With e the longest axis and W p = (g, h) along e and across it, the tangents are the images of (h, -g)
        / m in the plane of both, and of the vector perpendicular to that plane. Neither takes a difference
        along e, so needles do not cancel.
        """
        e0, e1, e2 = u, v, w
        s0, s1, s2 = sizes[0], sizes[1], sizes[2]
        if s1 > s0 and s1 >= s2:
            e0, e1, e2 = v, w, u
            s0, s1, s2 = sizes[1], sizes[2], sizes[0]
        elif s2 > s0:
            e0, e1, e2 = w, u, v
            s0, s1, s2 = sizes[2], sizes[0], sizes[1]
        shortest = wp.min(s1, s2)
        # in units of the shortest axis, so that nothing overflows
        g = wp.dot(e0, towards) * (shortest / s0)
        h1, h2 = wp.dot(e1, towards) * (shortest / s1), wp.dot(e2, towards) * (shortest / s2)
        h = wp.sqrt(h1 * h1 + h2 * h2)
        m = wp.sqrt(g * g + h * h)
        c1, c2 = one, zero
        if h > zero:
            c1 = h1 / h
            c2 = h2 / h
        inverse_m = real(wp.inf)
        a, b, area = u, v, one
        if m > zero:
            inverse_m = shortest / m
            a = e0 * (s0 * (h / m)) - (e1 * (s1 * c1) + e2 * (s2 * c2)) * (g / m)
            b = e1 * (s1 * c2) - e2 * (s2 * c1)
            # the inverse covariance times `towards`: the disk's normal
            across = e0 * (g * (shortest / s0)) + e1 * (h1 * (shortest / s1)) + e2 * (h2 * (shortest / s2))
            area = s0 * wp.max(s1, s2) * m / wp.dot(wp.normalize(across), towards)
        return a, b, area, inverse_m

    @wp.func
    def ewa(a: vec3, b: vec3, c: vec3, p: vec3, view: View):
        """Equivalent disk with ellipsoid="ewa", from scaled axes: tangents of a disk that faces the camera
        and has the widened image, and the factor of the opacity."""
        per_x, per_y = real(view.focal_x), real(view.focal_y)
        slope_x, slope_y = zero, zero
        if wp.static(not parallel):
            per_x /= p[2]
            per_y /= p[2]
            slope_x = wp.clamp(p[0] / p[2], -real(view.slopes[0]), real(view.slopes[1]))
            slope_y = wp.clamp(p[1] / p[2], -real(view.slopes[2]), real(view.slopes[3]))
        across = vec3(a[0] - slope_x * a[2], b[0] - slope_x * b[2], c[0] - slope_x * c[2]) * per_x
        down = vec3(a[1] - slope_y * a[2], b[1] - slope_y * b[2], c[1] - slope_y * c[2]) * per_y
        spread = widening / real(view.per_pixel)
        xx, yy = wp.dot(across, across) + spread, wp.dot(down, down) + spread
        turned = wp.cross(across, down)  # so that the determinant does not cancel
        before = wp.dot(turned, turned)
        after = before + spread * (xx + yy - spread)
        wide = wp.sqrt(xx)
        share = one
        if wp.static(antialiased):
            share = wp.sqrt(before / after)
        return (
            vec3(wide / per_x, wp.dot(across, down) / wide / per_y, zero),
            vec3(zero, wp.sqrt(after) / wide / per_y, zero),
            share,
        )

    @wp.func
    def disk(tangent_u: vec3, tangent_v: vec3, sizes: vec3, p: vec3, view: View):
        """Equivalent disk, from unit tangents and three standard deviations.

        Returns its scaled tangents, the half axis that is conjugate to them, 1 / m^2, its area, and the
        factor of the opacity, 0 if the splat is culled.
        """
        tangent_w = wp.cross(tangent_u, tangent_v)
        third = vec3()
        inverse_m2, spanned, share = zero, one, zero
        a, b = tangent_u, tangent_v
        if wp.static(sharp):
            towards = p
            if wp.static(parallel):
                towards = vec3(zero, zero, one)
            a, b, spanned, inverse_m = exact(tangent_u, tangent_v, tangent_w, sizes, towards)
            if inverse_m < real(wp.inf):  # else the camera is at its centre, and no ray has a maximum ahead
                share = one
                third = towards * inverse_m
                if wp.static(not parallel):
                    inverse_m2 = inverse_m * inverse_m
        else:
            if p[2] >= real(view.near):
                scaled_u, scaled_v = tangent_u * sizes[0], tangent_v * sizes[1]
                a, b, share = ewa(scaled_u, scaled_v, tangent_w * sizes[2], p, view)
                spanned = a[0] * b[1]
        return a, b, third, inverse_m2, spanned, share

    @wp.func
    def surface(tangent_u: vec3, tangent_v: vec3, sizes: vec3, p: vec3) -> vec3:
        """Unit normal of the surface of maxima along rays, at the centre, away from the camera: the inverse
        covariance times the ray, in units of the shortest axis."""
        towards = p
        if wp.static(parallel):
            towards = vec3(zero, zero, one)
        shortest = wp.min(sizes[0], wp.min(sizes[1], sizes[2]))
        u, v, w = shortest / sizes[0], shortest / sizes[1], shortest / sizes[2]
        tangent_w = wp.cross(tangent_u, tangent_v)
        across = tangent_u * (u * u * wp.dot(tangent_u, towards)) + tangent_v * (
            v * v * wp.dot(tangent_v, towards)
        )
        return wp.normalize(across + tangent_w * (w * w * wp.dot(tangent_w, towards)))

    @wp.func
    def rim(radius: real, inverse_m2: real) -> real:
        """Radius of the disk that the cone around the ellipsoid touches; large if the camera is inside of it,
        since all rays ahead can hit it then."""
        return radius / wp.sqrt(wp.max(one - radius * radius * inverse_m2 - within, real(1e-12)))

    @wp.func
    def reach(a: vec3, b: vec3, third: vec3, radius: real) -> real:
        """Half of the ellipsoid's depth range; of fisheyes and panoramas a bound of its distance range."""
        if wp.static(along_ray):
            return radius * wp.sqrt(wp.dot(a, a) + wp.dot(b, b) + wp.dot(third, third))
        else:
            return radius * wp.sqrt(a[2] * a[2] + b[2] * b[2] + third[2] * third[2])

    @wp.func
    def clipped(box: Bounds, a: vec3, b: vec3, p: vec3, third: vec3, inverse_m2: real, view: View) -> Bounds:
        """Bounds of the part of an ellipsoid beyond the near plane, in a pinhole image.

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

    return SimpleNamespace(disk=disk, surface=surface, rim=rim, reach=reach, clipped=clipped)
