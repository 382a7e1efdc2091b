"""The low-pass `pixel`: a splat convolved, in its own plane, with what a sample sees of that plane."""

from functools import cache

import warp as wp


@cache
def make_filter(real):
    """widened(a, b, by_x, by_y): how a Gaussian with scaled tangents a, b is filtered, with gradients of the
    sample's column and row by the point at its centre (slopes.py).

    G, 2 x 2, is the derivative of the sample's position by (u, v) at the centre. A sample of standard
    deviation s = 1/2 has the covariance s^2 (G^T G)^-1 in (u, v), so the filtered one has
    C = 1 + s^2 (G^T G)^-1 there: with L L^T = C its tangents are (a, b) L, and its area grows by sqrt(det C).
    """
    vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
    one = real(1.0)
    variance = real(0.25)

    @wp.func
    def widened(a: vec3, b: vec3, by_x: vec3, by_y: vec3):
        """L_uu, L_vu, L_vv, and the factor of the area; not finite of a disk that is seen edge-on."""
        by_u = vec2(wp.dot(by_x, a), wp.dot(by_y, a))
        by_v = vec2(wp.dot(by_x, b), wp.dot(by_y, b))
        area = by_u[0] * by_v[1] - by_v[0] * by_u[1]
        share = variance / (area * area)
        uu, uv, vv = wp.dot(by_u, by_u), wp.dot(by_u, by_v), wp.dot(by_v, by_v)
        # det(1 + s^2 M^-1) = 1 + s^2 (tr M + s^2) / det M: no cancellation
        grown = wp.sqrt(one + share * (uu + vv + variance))
        l_uu = wp.sqrt(one + share * vv)
        return vec4(l_uu, -share * uv / l_uu, grown / l_uu, grown)

    return widened
