"""Low-pass filter `pixel`: convolution of a splat, in its plane, with the footprint of a sample."""

from functools import cache

import warp as wp


@cache
def make_filter(real):
    """Make widened(a, b, by_x, by_y, by_depth), the low-pass filter of a Gaussian with scaled tangents a, b.

    by_x, by_y, by_depth: gradients with respect to the point, at the centre, of the sample's column, of its
    row and of the logarithm of the depth (projection_derivatives.py).

    The footprint of a sample is a Gaussian around its ray, with a standard deviation of s = 1/2 samples
    across the ray and of an eighth of the depth along it. G, 3 x 2, is the derivative of column, row and
    scaled logarithm of the depth with respect to (u, v) at the centre. The footprint thus has the covariance
    s^2 (G^T G)^-1 in (u, v), and the filtered Gaussian C = 1 + s^2 (G^T G)^-1. With the Cholesky factor
    L L^T = C, the tangents of the filtered Gaussian are (a, b) L, and its area is sqrt(det C) times as large.
    """
    vec3, vec4 = (wp.types.vector(n, real) for n in (3, 4))
    one = real(1.0)
    variance = real(0.25)
    whole_depth = real(0.5 * 8.0)  # scale of the logarithm of the depth: s = 1/2 is an eighth of the depth

    @wp.func
    def widened(a: vec3, b: vec3, by_x: vec3, by_y: vec3, by_depth: vec3):
        """Returns L_uu, L_vu, L_vv and det C, which is not finite for an edge-on disk with parallel rays."""
        grad_u = vec3(wp.dot(by_x, a), wp.dot(by_y, a), whole_depth * wp.dot(by_depth, a))
        grad_v = vec3(wp.dot(by_x, b), wp.dot(by_y, b), whole_depth * wp.dot(by_depth, b))
        minors = wp.cross(grad_u, grad_v)
        area2 = minors[2] * minors[2] + minors[1] * minors[1] + minors[0] * minors[0]
        uu, uv, vv = wp.dot(grad_u, grad_u), wp.dot(grad_u, grad_v), wp.dot(grad_v, grad_v)
        # det(1 + s^2 M^-1) = 1 + s^2 (tr M + s^2) / det M: no cancellation
        grown = one + variance * (uu + vv + variance) / area2
        l_uu = wp.sqrt(one + variance * vv / area2)
        return vec4(l_uu, -variance * uv / area2 / l_uu, wp.sqrt(grown) / l_uu, grown)

    return widened
