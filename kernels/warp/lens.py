"""Lenses with a ray buffer: projection of points, and bounds of splats in the image.

Bounds are computed in two coordinates of directions: the undistorted image of a distorted camera, the
stereographic projection of a fisheye. An inverse lookup table, from cells of these coordinates to samples,
converts them to bounds of samples, so that they hold for the rays in the buffer.
"""

import math
from functools import cache
from types import SimpleNamespace

import warp as wp

from .bounds import box_bounds
from .common import View, struct_of

COEFFICIENTS = {
    "camera_brown_conrady": wp.types.vector(12, wp.float64),  # k1 to k6, p1, p2, s1 to s4
    "camera_fisheye": wp.vec4d,  # k1 to k4
}
"""distortion coefficients of the lenses that have a lookup table; in uniforms they precede the limit of the
field of view: squared radius at which the distortion folds back, or maximum angle
"""
LENSES = (*COEFFICIENTS, "camera_equirectangular")


@cache
def make_lens(camera: str | None):
    """Struct Lens, the inputs of the projection; empty for cameras without a lens."""
    fields = {"rays": wp.array(dtype=wp.vec3)}
    if camera in COEFFICIENTS:
        fields |= {
            "k": COEFFICIENTS[camera],
            "limit": wp.float64,
            # first and last column and row of the samples in each cell; then grids of half the resolution
            "cells": wp.array(dtype=wp.vec4s),
            "side": wp.int32,  # cells per side
            "low": wp.vec2d,  # corner of the first cell
            "per_unit": wp.vec2d,  # cells per unit of the coordinates
            "top": wp.int32,  # row of the table's image that is the first row of this band
        }
    return struct_of("Lens", "Inputs of the projection by a lens.", fields if camera else {})


@cache
def make_optics(camera: str, real) -> SimpleNamespace:
    """Make functions of a lens.

    image(p, view, lens): image coordinates of a point, and whether it is in the field of view. anchor(x, y,
    imaged, p, view, lens): the ray to which a splat's forms are relative. Bounds in samples: lut_bounds(x0,
    x1, y0, y1, lens) of a box of the lookup table, enclose(a, b, p, radius, view, lens) of a disk.
    """
    Lens = make_lens(camera)
    vec2, vec3 = wp.types.vector(2, real), wp.types.vector(3, real)
    zero, half, one, two, pi = real(0.0), real(0.5), real(1.0), real(2.0), real(math.pi)
    # margins for the rounding of rays and of the per-sample test: relative; radians or units; cells
    more, pad, margin = real(1.0002), real(1e-6), real(0.02)

    @wp.func
    def cone(a: vec3, b: vec3, p: vec3, radius: real) -> real:
        """Half angle of a cone around p that contains the disk p + u a + v b, u^2 + v^2 <= radius^2; pi if it
        is a right angle or more.

        |p x c| / (p c) is the tangent of the angle of a point c: the bound is the maximum of the numerator
        over the minimum of the denominator.
        """
        across_a, across_b = wp.cross(p, a), wp.cross(p, b)
        aa, ab, bb = wp.dot(across_a, across_a), wp.dot(across_a, across_b), wp.dot(across_b, across_b)
        widest = half * (aa + bb + wp.sqrt((aa - bb) * (aa - bb) + real(4.0) * ab * ab))
        along_a, along_b = wp.dot(p, a), wp.dot(p, b)
        along = wp.dot(p, p) - radius * wp.sqrt(along_a * along_a + along_b * along_b)
        if along > zero:
            return wp.atan2(radius * wp.sqrt(widest), along) * more + pad
        return pi

    @wp.func
    def lut_bounds(x0: real, x1: real, y0: real, y1: real, lens: Lens):
        """Bounds of the samples whose rays are in [x0, x1] x [y0, y1] of the lookup table."""
        side = lens.side
        end = real(side)
        low = vec2(
            (x0 - real(lens.low[0])) * real(lens.per_unit[0]) - margin,
            (y0 - real(lens.low[1])) * real(lens.per_unit[1]) - margin,
        )
        high = vec2(
            (x1 - real(lens.low[0])) * real(lens.per_unit[0]) + margin,
            (y1 - real(lens.low[1])) * real(lens.per_unit[1]) + margin,
        )
        left, right, top, bottom = int(32767), int(-1), int(32767), int(-1)
        if high[0] >= zero and low[0] <= end and high[1] >= zero and low[1] <= end:
            i0, i1 = cell(low[0], side), cell(high[0], side)
            j0, j1 = cell(low[1], side), cell(high[1], side)
            grid = int(0)
            # the coarser grid in which the box has fewer than 7 cells a side
            while i1 - i0 >= 6 or j1 - j0 >= 6:
                grid += side * side
                side = side / 2
                i0, i1, j0, j1 = i0 / 2, i1 / 2, j0 / 2, j1 / 2
            for j in range(j0, j1 + 1):
                for i in range(i0, i1 + 1):
                    samples = lens.cells[grid + j * side + i]
                    left, right = wp.min(left, int(samples[0])), wp.max(right, int(samples[1]))
                    top, bottom = wp.min(top, int(samples[2])), wp.max(bottom, int(samples[3]))
        # without samples the box is inverted: empty
        return box_bounds(
            float(left) + 0.5, float(right) + 0.5, float(top - lens.top) + 0.5, float(bottom - lens.top) + 0.5
        )

    @wp.func
    def cell(x: real, side: int) -> int:
        return wp.min(int(wp.clamp(x, zero, real(side))), side - 1)

    @wp.func
    def image_distorted(p: vec3, view: View, lens: Lens):
        x, y = p[0] / p[2], p[1] / p[2]
        q = x * x + y * y
        k1, k2, k3 = real(lens.k[0]), real(lens.k[1]), real(lens.k[2])
        k4, k5, k6 = real(lens.k[3]), real(lens.k[4]), real(lens.k[5])
        p1, p2 = real(lens.k[6]), real(lens.k[7])
        s1, s2, s3, s4 = real(lens.k[8]), real(lens.k[9]), real(lens.k[10]), real(lens.k[11])
        radial = (one + q * (k1 + q * (k2 + q * k3))) / (one + q * (k4 + q * (k5 + q * k6)))
        a = x * radial + two * p1 * x * y + p2 * (q + two * x * x) + q * (s1 + q * s2)
        b = y * radial + p1 * (q + two * y * y) + two * p2 * x * y + q * (s3 + q * s4)
        return (
            real(view.focal_x) * a + real(view.center_x),
            real(view.focal_y) * b + real(view.center_y),
            q < real(lens.limit),
        )

    @wp.func
    def image_fisheye(p: vec3, view: View, lens: Lens):
        across = wp.sqrt(p[0] * p[0] + p[1] * p[1])
        angle = wp.atan2(across, p[2])
        q = angle * angle
        k1, k2, k3, k4 = real(lens.k[0]), real(lens.k[1]), real(lens.k[2]), real(lens.k[3])
        away = angle * (one + q * (k1 + q * (k2 + q * (k3 + q * k4))))
        factor = zero
        if across > zero:
            factor = away / across
        x = real(view.focal_x) * (factor * p[0]) + real(view.center_x)
        y = real(view.focal_y) * (factor * p[1]) + real(view.center_y)
        return x, y, angle <= real(lens.limit)

    @wp.func
    def extremes(above: vec3, below: vec3, radius: real) -> vec2:
        """Minimum and maximum of (above (u, v, 1)) / (below (u, v, 1)) with u^2 + v^2 <= radius^2, for a
        divisor above 0.
        """
        middle = above[2] / below[2]
        slope = vec2(below[0], below[1])
        x = vec2(above[0], above[1]) - middle * slope
        reach = radius * wp.length(slope)
        h = radius * radius / ((below[2] - reach) * (below[2] + reach))
        m = -h * wp.dot(x, slope)
        aside = wp.sqrt(m * m + h * wp.dot(x, x))
        return vec2(middle + m - aside, middle + m + aside)

    @wp.func
    def enclose_fisheye(a: vec3, b: vec3, p: vec3, radius: real, view: View, lens: Lens):
        """Bounds of a disk in a fisheye image, by the stereographic projection (X, Y) / (|r| + Z).

        |r| is between the component of r along p and this component over the cosine of the cone's half angle.
        The quotient is monotonic in |r|, so its extremes are at these two values.
        """
        away, w = wp.length(p), cone(a, b, p, radius)
        x0, x1, y0, y1 = real(wp.inf), -real(wp.inf), real(wp.inf), -real(wp.inf)
        for end in range(2):
            per_away = wp.where(end == 0, one, one / wp.cos(w)) / away
            below = vec3(
                a[2] + per_away * wp.dot(a, p), b[2] + per_away * wp.dot(b, p), p[2] + per_away * away * away
            )
            # otherwise the disk may contain the direction -z, which is at infinity
            if (
                w < real(1.5)
                and below[2] - radius * wp.sqrt(below[0] * below[0] + below[1] * below[1]) > real(1e-3) * away
            ):
                x = extremes(vec3(a[0], b[0], p[0]), below, radius)
                y = extremes(vec3(a[1], b[1], p[1]), below, radius)
                x0, x1, y0, y1 = wp.min(x0, x[0]), wp.max(x1, x[1]), wp.min(y0, y[0]), wp.max(y1, y[1])
            else:
                x0, x1, y0, y1 = -real(wp.inf), real(wp.inf), -real(wp.inf), real(wp.inf)
        more_x, more_y = (x1 - x0) * (more - one) + pad, (y1 - y0) * (more - one) + pad
        return lut_bounds(x0 - more_x, x1 + more_x, y0 - more_y, y1 + more_y, lens)

    @wp.func
    def image_panorama(p: vec3, view: View, lens: Lens):
        longitude = wp.atan2(p[0], p[2])
        latitude = wp.atan2(p[1], wp.sqrt(p[0] * p[0] + p[2] * p[2]))
        return (
            real(view.focal_x) * longitude + real(view.center_x),
            real(view.focal_y) * latitude + real(view.center_y),
            True,
        )

    @wp.func
    def enclose_panorama(a: vec3, b: vec3, p: vec3, radius: real, view: View, lens: Lens):
        """Bounds of a disk in a panorama.

        A cone of half angle w around latitude t spans asin(sin w / cos t) of longitude to both sides; all
        longitudes if it contains a pole or crosses the edge of the image.
        """
        longitude = wp.atan2(p[0], p[2])
        latitude = wp.atan2(p[1], wp.sqrt(p[0] * p[0] + p[2] * p[2]))
        w = cone(a, b, p, radius)
        west, east = -pi, pi
        if wp.abs(latitude) + w < half * pi:
            aside = wp.asin(wp.min(wp.sin(w) / wp.cos(latitude), one)) * more + pad
            if wp.abs(longitude) + aside < pi:
                west = longitude - aside
                east = longitude + aside
        fx, fy, cx, cy = real(view.focal_x), real(view.focal_y), real(view.center_x), real(view.center_y)
        return box_bounds(
            float(fx * west + cx),
            float(fx * east + cx),
            float(fy * (latitude - w) + cy),
            float(fy * (latitude + w) + cy),
        )

    @wp.func
    def anchor(column: int, row: int, imaged: bool, p: vec3, view: View, lens: Lens) -> wp.vec3:
        """Ray of a sample, or the direction of p if the centre is not imaged or the sample has no ray."""
        ray = lens.rays[row * view.width + column]
        if not (imaged and ray[0] == ray[0]):
            away = wp.length(p)
            ray = wp.vec3(0.0, 0.0, 0.0)
            if away > zero:
                per = one / away
                ray = wp.vec3(float(p[0] * per), float(p[1] * per), float(p[2] * per))
        return ray

    image = {
        "camera_brown_conrady": image_distorted,
        "camera_fisheye": image_fisheye,
        "camera_equirectangular": image_panorama,
    }[camera]
    enclose = {"camera_fisheye": enclose_fisheye, "camera_equirectangular": enclose_panorama}.get(camera)
    return SimpleNamespace(Lens=Lens, image=image, anchor=anchor, lut_bounds=lut_bounds, enclose=enclose)
