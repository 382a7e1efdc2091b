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
        axes: wp.mat33d,
        sizes: wp.vec3d,
        p: wp.vec3d,
        grad_a: wp.vec3d,
        grad_b: wp.vec3d,
        grad_ellipsoid_term: wp.float64,
    ):
        """Gradients with respect to the scaled axes, in rows, and the centre. grad_ellipsoid_term: with
        respect to 2 / m^2.

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
        grad_m2 = -_FOUR * grad_ellipsoid_term * inverse_m * inverse_m  # the ellipsoid_term is 2 / m^2
        grad_y = grad_m2 / m * g - inverse_m * (wp.dot(p, grad_a) * e1 + wp.dot(p, grad_b) * e2)
        grad_y = inverse_m * wp.cw_div(grad_y, sizes)
        share = wp.cw_div(grad_y, sizes)
        grad_axes = wp.outer(e1, grad_a) + wp.outer(e2, grad_b) + wp.outer(share, p)
        grad_axes -= _TWO * (wp.diag(wp.cw_mul(share, along)) * axes)
        return grad_axes, wp.transpose(axes) * grad_y

    @wp.func
    def ewa(
        scaled: wp.mat33d, p: wp.vec3d, grad_a: wp.vec3d, grad_b: wp.vec3d, grad_p: wp.vec3d,
        grad_log: wp.float64, view: View,
    ):  # fmt: skip
        """Gradients with respect to the scaled axes, in rows, to the centre, and to fx, fy, cx, cy."""
        across, down, per = ellipsoid.image(scaled[0], scaled[1], scaled[2], p, view)
        factor, before, after = ellipsoid.widened(across, down, view)
        spread, ahead = _WIDENING / wp.float64(view.sample_area), _ONE / p[2]
        per_x, per_y, slope_x, slope_y = per[0], per[1], per[2], per[3]
        grad_l11, grad_l21, grad_l22 = grad_a[0] / per_x, grad_a[1] / per_y, grad_b[1] / per_y
        grad_per_x = -grad_l11 * factor[0] / per_x
        grad_per_y = -(grad_l21 * factor[1] + grad_l22 * factor[2]) / per_y
        grad_after = _HALF * grad_l22 * factor[2] / after
        grad_before = grad_after
        if wp.static(antialiased):
            grad_after -= _HALF * grad_log / after
            grad_before = grad_after + _HALF * grad_log / before
        grad_xx = _HALF * (grad_l11 - (grad_l21 * factor[1] + grad_l22 * factor[2]) / factor[0]) / factor[0]
        grad_xx += spread * grad_after
        grad_xy, grad_yy = grad_l21 / factor[0], spread * grad_after
        grad_crossed = _TWO * grad_before * wp.cross(across, down)
        grad_across = wp.cross(down, grad_crossed) + _TWO * grad_xx * across + grad_xy * down
        grad_down = wp.cross(grad_crossed, across) + _TWO * grad_yy * down + grad_xy * across
        grad_per_x += wp.dot(grad_across, across) / per_x
        grad_per_y += wp.dot(grad_down, down) / per_y
        grad_across *= per_x
        grad_down *= per_y
        columns = wp.transpose(scaled)
        grad_slope_x, grad_slope_y = -wp.dot(grad_across, columns[2]), -wp.dot(grad_down, columns[2])
        if slope_x != p[0] * ahead:  # slopes at their limits are constant
            grad_slope_x = wp.float64(0.0)
        if slope_y != p[1] * ahead:
            grad_slope_y = wp.float64(0.0)
        grad_z = grad_slope_x * slope_x + grad_slope_y * slope_y + grad_per_x * per_x + grad_per_y * per_y
        grad_center = grad_p + ahead * wp.vec3d(grad_slope_x, grad_slope_y, -grad_z)
        # images depend on fx x + cx z and fy y + cy z of the axes and the centre; limits of slopes are
        # constant in pixels
        grad_camera = wp.vec4d(
            (wp.dot(grad_across, columns[0]) + grad_center[0] * p[0]) * view.per_focal_x,
            (wp.dot(grad_down, columns[1]) + grad_center[1] * p[1]) * view.per_focal_y,
            (wp.dot(grad_across, columns[2]) + grad_center[0] * p[2]) * view.per_focal_x,
            (wp.dot(grad_down, columns[2]) + grad_center[1] * p[2]) * view.per_focal_y,
        )
        grad_ahead = -(slope_x * grad_across + slope_y * grad_down)
        return wp.matrix_from_cols(grad_across, grad_down, grad_ahead), grad_center, grad_camera

    @wp.func
    def normal(axes: wp.mat33d, sizes: wp.vec3d, p: wp.vec3d, grad_facet: wp.vec3d):
        """Gradients of the normal (`ellipsoids.surface`) with respect to the unit axes, in rows, their
        lengths, and the centre. A common factor of the lengths has no gradient."""
        shortest = wp.min(wp.min(sizes[0], sizes[1]), sizes[2])
        share = wp.cw_div(wp.vec3d(shortest, shortest, shortest), sizes)
        share = wp.cw_mul(share, share)
        along = wp.cw_mul(axes * p, share)
        outward = wp.transpose(axes) * along
        length = wp.length(outward)
        outward /= length
        grad_outward = (grad_facet - wp.dot(grad_facet, outward) * outward) / length
        grad_along = axes * grad_outward
        grad_dots = wp.cw_mul(grad_along, share)
        grad_axes = wp.outer(along, grad_outward) + wp.outer(grad_dots, p)
        grad_sizes = -_TWO * wp.cw_div(wp.cw_mul(grad_along, along), sizes)
        return grad_axes, grad_sizes, wp.transpose(axes) * grad_dots

    @wp.func
    def backward(
        axes: wp.mat33d,  # unit axes in rows, in the camera's frame
        sizes: wp.vec3d,
        p: wp.vec3d,
        grad_a: wp.vec3d,  # with respect to the disk's tangents and centre
        grad_b: wp.vec3d,
        grad_p: wp.vec3d,
        grad_camera: wp.vec4d,  # with respect to fx, fy, cx, cy
        grad_log: wp.float64,
        grad_ellipsoid_term: wp.float64,
        grad_facet: wp.vec3d,
        view: View,
    ):
        """Gradients with respect to the unit axes, in rows, their lengths, the centre, and fx, fy, cx, cy."""
        if wp.static(sharp):
            grad_scaled, grad_center = exact(axes, sizes, p, grad_a, grad_b, grad_ellipsoid_term)
            grad_center += grad_p
        else:
            grad_scaled, grad_center, grad_camera = ewa(
                wp.diag(sizes) * axes, p, grad_a, grad_b, grad_p, grad_log, view
            )
        grad_axes, grad_sizes, more = normal(axes, sizes, p, grad_facet)
        grad_axes += wp.diag(sizes) * grad_scaled
        for k in range(3):
            grad_sizes[k] = grad_sizes[k] + wp.dot(grad_scaled[k], axes[k])
        return grad_axes, grad_sizes, grad_center + more, grad_camera

    return backward
