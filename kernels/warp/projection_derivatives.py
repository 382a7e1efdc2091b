"""Derivatives of the projection of a point with respect to its position, for each camera."""

from functools import cache

import warp as wp

from .common import View
from .lens import LENSES, make_lens


@cache
def make_projection_derivatives(camera: str | None, real):
    """Make derivatives(p, view, lens): gradients, with respect to the point p, of its column and row [samples
    per metre] and of the logarithm of its depth [1/m] (0 for parallel rays), and whether p is in the field of
    view. camera: a lens; None for a pinhole.
    """
    Lens = make_lens(camera if camera in LENSES else None)
    vec3 = wp.types.vector(3, real)
    zero, one, two, three = (real(float(k)) for k in range(4))
    polar = real(1e-6)  # relative distance from a panorama's axis below which a point is at a pole

    @wp.func
    def derivatives_pinhole(p: vec3, view: View, lens: Lens):
        per_z = one / p[2]
        fx, fy = real(view.focal_x), real(view.focal_y)
        by_x = vec3(fx * per_z, zero, -fx * p[0] * per_z * per_z)
        by_y = vec3(zero, fy * per_z, -fy * p[1] * per_z * per_z)
        return by_x, by_y, vec3(zero, zero, per_z), True

    @wp.func
    def derivatives_parallel(p: vec3, view: View, lens: Lens):
        return vec3(real(view.focal_x), zero, zero), vec3(zero, real(view.focal_y), zero), vec3(), True

    @wp.func
    def derivatives_distorted(p: vec3, view: View, lens: Lens):
        """Derivatives of (x, y) radial(q) + ..., q = x^2 + y^2 in the undistorted image (lens.py)."""
        x, y = p[0] / p[2], p[1] / p[2]
        q = x * x + y * y
        k1, k2, k3 = real(lens.k[0]), real(lens.k[1]), real(lens.k[2])
        k4, k5, k6 = real(lens.k[3]), real(lens.k[4]), real(lens.k[5])
        p1, p2 = real(lens.k[6]), real(lens.k[7])
        s1, s2, s3, s4 = real(lens.k[8]), real(lens.k[9]), real(lens.k[10]), real(lens.k[11])
        below = one + q * (k4 + q * (k5 + q * k6))
        radial = (one + q * (k1 + q * (k2 + q * k3))) / below
        grad_q = k1 + q * (two * k2 + q * three * k3) - radial * (k4 + q * (two * k5 + q * three * k6))
        grad_q /= below
        mixed = two * (x * y * grad_q + p1 * x + p2 * y)
        prism_a, prism_b = two * (s1 + two * q * s2), two * (s3 + two * q * s4)
        a_x = radial + two * (x * x * grad_q + p1 * y + three * p2 * x) + x * prism_a
        b_y = radial + two * (y * y * grad_q + three * p1 * y + p2 * x) + y * prism_b
        a_y, b_x = mixed + y * prism_a, mixed + x * prism_b
        per_z = one / p[2]
        grad_a = vec3(a_x, a_y, -(x * a_x + y * a_y)) * per_z
        grad_b = vec3(b_x, b_y, -(x * b_x + y * b_y)) * per_z
        by_depth = vec3(zero, zero, per_z)
        return real(view.focal_x) * grad_a, real(view.focal_y) * grad_b, by_depth, q < real(lens.limit)

    @wp.func
    def derivatives_fisheye(p: vec3, view: View, lens: Lens):
        """Derivatives of a fisheye: radial, by the angle from the axis, and tangential."""
        across = wp.sqrt(p[0] * p[0] + p[1] * p[1])
        angle = wp.atan2(across, p[2])
        q = angle * angle
        k1, k2, k3, k4 = real(lens.k[0]), real(lens.k[1]), real(lens.k[2]), real(lens.k[3])
        grad_angle = one + q * (three * k1 + q * (real(5.0) * k2 + q * (real(7.0) * k3 + q * real(9.0) * k4)))
        cos, sin, per_across = one, zero, one / p[2]
        if across > zero:
            cos = p[0] / across
            sin = p[1] / across
            per_across = angle * (one + q * (k1 + q * (k2 + q * (k3 + q * k4)))) / across
        away = vec3(p[2] * cos, p[2] * sin, -across) * (grad_angle / wp.dot(p, p))
        around = vec3(-sin, cos, zero) * per_across
        by_x, by_y = cos * away - sin * around, sin * away + cos * around
        by_depth = p / wp.dot(p, p)
        return real(view.focal_x) * by_x, real(view.focal_y) * by_y, by_depth, angle <= real(lens.limit)

    @wp.func
    def derivatives_panorama(p: vec3, view: View, lens: Lens):
        """Derivatives of a panorama. At a pole, where longitude is discontinuous, derivatives at a
        neighbouring point towards z."""
        away2 = wp.dot(p, p)
        x, z = p[0], p[2]
        if x * x + z * z < polar * polar * away2:
            x = zero
            z = polar * wp.sqrt(away2)
        flat2 = x * x + z * z
        flat = wp.sqrt(flat2)
        by_x = vec3(z, zero, -x) / flat2
        by_y = vec3(-x * p[1] / flat, flat, -z * p[1] / flat) / away2
        return real(view.focal_x) * by_x, real(view.focal_y) * by_y, p / away2, True

    return {
        None: derivatives_pinhole,
        "camera_orthographic": derivatives_parallel,
        "camera_brown_conrady": derivatives_distorted,
        "camera_fisheye": derivatives_fisheye,
        "camera_equirectangular": derivatives_panorama,
    }[camera]
