"""Image bounds of a disk p + u a + v b, u^2 + v^2 <= radius^2."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .bounds import box_bounds, ellipse_bounds
from .common import View


@cache
def make_disk(real) -> SimpleNamespace:
    """Make functions for bounds of a disk: perspective(a, b, p, radius, reach, view) and parallel. reach:
    half of the disk's depth range.
    """
    vec2, vec3 = wp.types.vector(2, real), wp.types.vector(3, real)
    one, zero = real(1.0), real(0.0)

    @wp.func
    def extremes(a: real, b: real, p: real, depth: vec3, radius: real, near: real):
        """Minimum and maximum of (a u + b v + p) / (depth (u, v, 1)) on the arc u^2 + v^2 = radius^2 beyond
        `near`.

        The ratio's derivative along the arc vanishes where e cos + f sin = -g.
        """
        low = real(wp.inf)
        high = -real(wp.inf)
        e = b * depth[2] - p * depth[1]
        f = p * depth[0] - a * depth[2]
        g = (b * depth[0] - a * depth[1]) * radius
        h = wp.sqrt(e * e + f * f)
        if h > zero:
            along = -g / h
            if wp.abs(along) <= one:
                aside = wp.sqrt(one - along * along)
                for side in range(2):
                    s = wp.where(side == 0, aside, -aside)
                    u = radius * (along * e - s * f) / h
                    v = radius * (along * f + s * e) / h
                    z = depth[0] * u + depth[1] * v + depth[2]
                    if z >= near:
                        ratio = (a * u + b * v + p) / z
                        low = wp.min(low, ratio)
                        high = wp.max(high, ratio)
        return low, high

    @wp.func
    def clipped(a: vec3, b: vec3, p: vec3, radius: real, reach: real, view: View):
        """Box of the disk clipped at the near plane: around its arc and the chord at the plane.

        The clipped disk is convex and has positive depths, so that ratios are extreme on its border.
        """
        near = real(view.near)
        depth = vec3(a[2], b[2], p[2])
        x0, x1 = extremes(a[0], b[0], p[0], depth, radius, near)
        y0, y1 = extremes(a[1], b[1], p[1], depth, radius, near)
        g = a[2] * a[2] + b[2] * b[2]
        if p[2] - reach < near and g > zero:
            k = near - p[2]
            swing = wp.sqrt(wp.max(radius * radius * g - k * k, zero))
            for side in range(2):
                s = wp.where(side == 0, swing, -swing)
                u = (k * a[2] - s * b[2]) / g
                v = (k * b[2] + s * a[2]) / g
                x = (a[0] * u + b[0] * v + p[0]) / near
                y = (a[1] * u + b[1] * v + p[1]) / near
                x0 = wp.min(x0, x)
                x1 = wp.max(x1, x)
                y0 = wp.min(y0, y)
                y1 = wp.max(y1, y)
        fx, fy, cx, cy = real(view.focal_x), real(view.focal_y), real(view.center_x), real(view.center_y)
        return box_bounds(float(x0 * fx + cx), float(x1 * fx + cx), float(y0 * fy + cy), float(y1 * fy + cy))

    @wp.func
    def ellipse(a: vec3, b: vec3, p: vec3, radius: real, reach: real, view: View):
        """Image of a disk that is completely beyond the near plane, from its dual conic about the projected
        centre.
        """
        fx, fy = real(view.focal_x), real(view.focal_y)
        px, py = p[0] / p[2], p[1] / p[2]
        x = vec2(fx * (a[0] - px * a[2]), fx * (b[0] - px * b[2]))
        y = vec2(fy * (a[1] - py * a[2]), fy * (b[1] - py * b[2]))
        z = vec2(a[2], b[2])
        h = radius * radius / ((p[2] - reach) * (p[2] + reach))
        mx = -h * wp.dot(x, z)
        my = -h * wp.dot(y, z)
        qxx = wp.max(mx * mx + h * wp.dot(x, x), zero)
        qyy = wp.max(my * my + h * wp.dot(y, y), zero)
        qxy = mx * my + h * wp.dot(x, y)
        return conic(fx * px + real(view.center_x) + mx, fy * py + real(view.center_y) + my, qxx, qyy, qxy)

    @wp.func
    def parallel(a: vec3, b: vec3, x: real, y: real, radius: real, view: View):
        """Bounds of a disk in an orthographic image, with the projected centre (x, y)."""
        fx, fy = real(view.focal_x), real(view.focal_y)
        across, down = vec2(fx * a[0], fx * b[0]) * radius, vec2(fy * a[1], fy * b[1]) * radius
        return conic(x, y, wp.dot(across, across), wp.dot(down, down), wp.dot(across, down))

    @wp.func
    def conic(x: real, y: real, qxx: real, qyy: real, qxy: real):
        """Ellipse around (x, y) with half extents sqrt(qxx) along x and sqrt(qyy) along y."""
        shear = zero
        if qyy > zero:
            shear = qxy / qyy
        # padded for the rounding of float32
        half_x = wp.sqrt(float(qxx))
        tip = float(0.0)
        if half_x > 0.0:
            tip = float(qxy) / half_x
        return ellipse_bounds(
            float(x),
            float(y),
            half_x,
            wp.sqrt(float(qyy)),
            float(shear),
            wp.sqrt(float(wp.max(qxx - qxy * shear, zero))),
            tip,
        )

    @wp.func
    def perspective(a: vec3, b: vec3, p: vec3, radius: real, reach: real, view: View):
        """Bounds of a disk in the image of a pinhole camera."""
        if p[2] - reach >= real(view.near):
            return ellipse(a, b, p, radius, reach, view)
        return clipped(a, b, p, radius, reach, view)

    return SimpleNamespace(perspective=perspective, parallel=parallel)
