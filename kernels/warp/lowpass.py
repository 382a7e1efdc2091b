"""The low-pass `pixel`: a splat convolved, in its own plane, with the footprint of a sample."""

from functools import cache

import warp as wp


@cache
def make_filter(real):
    """widened(a, b, by_x, by_y, by_depth): how a Gaussian with scaled tangents a, b is filtered, with
    gradients by the point at its centre of the sample's column and row and of the logarithm of the depth
    (slopes.py).

    What a sample sees is a Gaussian about its ray, with a standard deviation of s = 1/2 samples across and of
    an eighth of the depth along it. G, 3 x 2, is the derivative by (u, v) at the centre of what the two are
    in samples, so it has the covariance s^2 (G^T G)^-1 in (u, v), and the filtered one has
    C = 1 + s^2 (G^T G)^-1 there: with L L^T = C its tangents are (a, b) L, and its area grows by sqrt(det C).
    """
    vec3, vec4 = (wp.types.vector(n, real) for n in (3, 4))
    one = real(1.0)
    variance = real(0.25)
    whole_depth = real(0.5 * 8.0)  # samples that it is taken for

    @wp.func
    def widened(a: vec3, b: vec3, by_x: vec3, by_y: vec3, by_depth: vec3):
        """L_uu, L_vu, L_vv, and the square of the factor of the area, which with parallel rays is not
        finite for a disk that is edge-on."""
        by_u = vec3(wp.dot(by_x, a), wp.dot(by_y, a), whole_depth * wp.dot(by_depth, a))
        by_v = vec3(wp.dot(by_x, b), wp.dot(by_y, b), whole_depth * wp.dot(by_depth, b))
        minors = wp.cross(by_u, by_v)
        area2 = minors[2] * minors[2] + minors[1] * minors[1] + minors[0] * minors[0]
        uu, uv, vv = wp.dot(by_u, by_u), wp.dot(by_u, by_v), wp.dot(by_v, by_v)
        # det(1 + s^2 M^-1) = 1 + s^2 (tr M + s^2) / det M: no cancellation
        grown = one + variance * (uu + vv + variance) / area2
        l_uu = wp.sqrt(one + variance * vv / area2)
        return vec4(l_uu, -variance * uv / area2 / l_uu, wp.sqrt(grown) / l_uu, grown)

    return widened
