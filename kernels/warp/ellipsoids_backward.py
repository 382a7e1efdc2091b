"""Backward pass of the equivalent disks of 3D Gaussians (ellipsoids.py), in float64: from gradients with
respect to the disk to gradients with respect to the axes and the centre of the Gaussian."""

from functools import cache

import warp as wp

from .common import View
from .ellipsoids import EXACT, make_ellipsoids

_HALF, _ONE, _TWO, _FOUR, _WIDENING = (wp.constant(wp.float64(x)) for x in (0.5, 1.0, 2.0, 4.0, 0.3))


@cache
def make_ellipsoids_backward(effects: tuple[str, ...]):
    """Make the function `backward` for the effects."""
    sharp, antialiased = EXACT in effects, "ellipsoid_ewa_antialiased" in effects
    ellipsoid = make_ellipsoids(effects, wp.float64)

    @wp.func
    def exact(
        axes: wp.mat33d, sizes: wp.vec3d, p: wp.vec3d, by_a: wp.vec3d, by_b: wp.vec3d, by_bulge: wp.float64
    ):
        """Gradients with respect to the scaled axes, in rows, and the centre. by_bulge: with respect to
        2 / m^2.

        The disk's tangents a, b and p / m are the images of unit vectors e1, e2, e3 under V, whose columns
        are the scaled axes; V^-1 p = m e3. The splat depends on a a^T + b b^T only, so that e1 and e2 rotate
        with e3.
        """
        shortest = wp.min(wp.min(sizes[0], sizes[1]), sizes[2])
        i0 = int(2)
        if sizes[0] >= sizes[1] and sizes[0] >= sizes[2]:
            i0 = 0
        elif sizes[1] >= sizes[2]:
            i0 = 1
        i1, i2 = (i0 + 1) % 3, (i0 + 2) % 3
        along = axes * p
        g = shortest * wp.cw_div(along, sizes)
        h, m = wp.sqrt(g[i1] * g[i1] + g[i2] * g[i2]), wp.length(g)
        k1, k2 = _ONE, wp.float64(0.0)
        if h > wp.float64(0.0):
            k1 = g[i1] / h
            k2 = g[i2] / h
        e1, e2 = wp.vec3d(), wp.vec3d()
        e1[i0] = h / m
        e1[i1] = -g[i0] / m * k1
        e1[i2] = -g[i0] / m * k2
        e2[i1] = k2
        e2[i2] = -k1
        inverse_m = shortest / m
        by_m2 = -_FOUR * by_bulge * inverse_m * inverse_m  # the bulge is 2 / m^2
        by_y = by_m2 / m * g - inverse_m * (wp.dot(p, by_a) * e1 + wp.dot(p, by_b) * e2)
        by_y = inverse_m * wp.cw_div(by_y, sizes)
        share = wp.cw_div(by_y, sizes)
        by_axes = wp.outer(e1, by_a) + wp.outer(e2, by_b) + wp.outer(share, p)
        by_axes -= _TWO * (wp.diag(wp.cw_mul(share, along)) * axes)
        return by_axes, wp.transpose(axes) * by_y

    @wp.func
    def ewa(
        scaled: wp.mat33d, p: wp.vec3d, by_a: wp.vec3d, by_b: wp.vec3d, by_p: wp.vec3d, by_log: wp.float64,
        view: View,
    ):  # fmt: skip
        """Gradients with respect to the scaled axes, in rows, to the centre, and to fx, fy, cx, cy."""
        across, down, per = ellipsoid.image(scaled[0], scaled[1], scaled[2], p, view)
        factor, before, after = ellipsoid.widened(across, down, view)
        spread, ahead = _WIDENING / wp.float64(view.per_pixel), _ONE / p[2]
        per_x, per_y, slope_x, slope_y = per[0], per[1], per[2], per[3]
        by_l11, by_l21, by_l22 = by_a[0] / per_x, by_a[1] / per_y, by_b[1] / per_y
        by_per_x = -by_l11 * factor[0] / per_x
        by_per_y = -(by_l21 * factor[1] + by_l22 * factor[2]) / per_y
        by_after = _HALF * by_l22 * factor[2] / after
        by_before = by_after
        if wp.static(antialiased):
            by_after -= _HALF * by_log / after
            by_before = by_after + _HALF * by_log / before
        by_xx = _HALF * (by_l11 - (by_l21 * factor[1] + by_l22 * factor[2]) / factor[0]) / factor[0]
        by_xx += spread * by_after
        by_xy, by_yy = by_l21 / factor[0], spread * by_after
        by_crossed = _TWO * by_before * wp.cross(across, down)
        by_across = wp.cross(down, by_crossed) + _TWO * by_xx * across + by_xy * down
        by_down = wp.cross(by_crossed, across) + _TWO * by_yy * down + by_xy * across
        by_per_x += wp.dot(by_across, across) / per_x
        by_per_y += wp.dot(by_down, down) / per_y
        by_across *= per_x
        by_down *= per_y
        columns = wp.transpose(scaled)
        by_slope_x, by_slope_y = -wp.dot(by_across, columns[2]), -wp.dot(by_down, columns[2])
        if slope_x != p[0] * ahead:  # slopes at their limits are constant
            by_slope_x = wp.float64(0.0)
        if slope_y != p[1] * ahead:
            by_slope_y = wp.float64(0.0)
        by_z = by_slope_x * slope_x + by_slope_y * slope_y + by_per_x * per_x + by_per_y * per_y
        by_center = by_p + ahead * wp.vec3d(by_slope_x, by_slope_y, -by_z)
        # images depend on fx x + cx z and fy y + cy z of the axes and the centre; limits of slopes are
        # constant in pixels
        by_camera = wp.vec4d(
            (wp.dot(by_across, columns[0]) + by_center[0] * p[0]) * view.per_focal_x,
            (wp.dot(by_down, columns[1]) + by_center[1] * p[1]) * view.per_focal_y,
            (wp.dot(by_across, columns[2]) + by_center[0] * p[2]) * view.per_focal_x,
            (wp.dot(by_down, columns[2]) + by_center[1] * p[2]) * view.per_focal_y,
        )
        by_ahead = -(slope_x * by_across + slope_y * by_down)
        return wp.matrix_from_cols(by_across, by_down, by_ahead), by_center, by_camera

    @wp.func
    def normal(axes: wp.mat33d, sizes: wp.vec3d, p: wp.vec3d, by_facet: wp.vec3d):
        """Gradients of the normal (`ellipsoids.surface`) with respect to the unit axes, in rows, their
        lengths, and the centre. A common factor of the lengths has no gradient."""
        shortest = wp.min(wp.min(sizes[0], sizes[1]), sizes[2])
        share = wp.cw_div(wp.vec3d(shortest, shortest, shortest), sizes)
        share = wp.cw_mul(share, share)
        along = wp.cw_mul(axes * p, share)
        outward = wp.transpose(axes) * along
        length = wp.length(outward)
        outward /= length
        by_outward = (by_facet - wp.dot(by_facet, outward) * outward) / length
        by_along = axes * by_outward
        by_dots = wp.cw_mul(by_along, share)
        by_axes = wp.outer(along, by_outward) + wp.outer(by_dots, p)
        by_sizes = -_TWO * wp.cw_div(wp.cw_mul(by_along, along), sizes)
        return by_axes, by_sizes, wp.transpose(axes) * by_dots

    @wp.func
    def backward(
        axes: wp.mat33d,  # unit axes in rows, in the camera's frame
        sizes: wp.vec3d,
        p: wp.vec3d,
        by_a: wp.vec3d,  # with respect to the disk's tangents and centre
        by_b: wp.vec3d,
        by_p: wp.vec3d,
        by_camera: wp.vec4d,  # with respect to fx, fy, cx, cy
        by_log: wp.float64,
        by_bulge: wp.float64,
        by_facet: wp.vec3d,
        view: View,
    ):
        """Gradients with respect to the unit axes, in rows, their lengths, the centre, and fx, fy, cx, cy."""
        if wp.static(sharp):
            by_scaled, by_center = exact(axes, sizes, p, by_a, by_b, by_bulge)
            by_center += by_p
        else:
            by_scaled, by_center, by_camera = ewa(wp.diag(sizes) * axes, p, by_a, by_b, by_p, by_log, view)
        by_axes, by_sizes, more = normal(axes, sizes, p, by_facet)
        by_axes += wp.diag(sizes) * by_scaled
        for k in range(3):
            by_sizes[k] = by_sizes[k] + wp.dot(by_scaled[k], axes[k])
        return by_axes, by_sizes, by_center + more, by_camera

    return backward
