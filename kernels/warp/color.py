"""Colour of a splat: plain, or spherical harmonics in the direction from the camera (convention of gsplat and
the 2DGS authors).
"""

from functools import cache

import warp as wp

from .common import fma3

# Y_k(x, y, z) = constant x polynomial, degrees 1 to 3; degree 0 is C0
C0 = wp.constant(0.28209479177387814)


@wp.func
def basis_value(k: int, d: wp.vec3) -> float:
    """Real spherical harmonic number k, 0 to 15, of a unit direction."""
    x, y, z = d[0], d[1], d[2]
    if k == 0:
        return C0
    elif k == 1:
        return -0.48860251190291992 * y
    elif k == 2:
        return 0.48860251190291992 * z
    elif k == 3:
        return -0.48860251190291992 * x
    elif k == 4:
        return 1.0925484305920792 * (x * y)
    elif k == 5:
        return -1.0925484305920792 * (y * z)
    elif k == 6:
        return 0.31539156525252005 * (2.0 * z * z - x * x - y * y)
    elif k == 7:
        return -1.0925484305920792 * (x * z)
    elif k == 8:
        return 0.54627421529603959 * (x * x - y * y)
    elif k == 9:
        return -0.59004358992664352 * y * (3.0 * (x * x) - y * y)
    elif k == 10:
        return 2.8906114426405538 * (x * y) * z
    elif k == 11:
        return -0.45704579946446572 * y * (4.0 * z * z - x * x - y * y)
    elif k == 12:
        return 0.37317633259011546 * z * (2.0 * z * z - 3.0 * (x * x) - 3.0 * (y * y))
    elif k == 13:
        return -0.45704579946446572 * x * (4.0 * z * z - x * x - y * y)
    elif k == 14:
        return 1.4453057213202769 * z * (x * x - y * y)
    return -0.59004358992664352 * x * (x * x - 3.0 * (y * y))


@cache
def make_color(sh_coefficients: int, real):
    """Make color_of(i, colors, away), with away = centre - camera in world axes. sh_coefficients: 0 for plain
    colours."""
    vec3 = wp.types.vector(3, real)

    @wp.func
    def plain(i: int, colors: wp.array(dtype=wp.vec3), away: vec3) -> wp.vec3:
        return colors[i]

    @wp.func
    def harmonic(i: int, colors: wp.array(dtype=wp.vec3), away: vec3) -> wp.vec3:
        length = wp.length(away)
        direction = wp.vec3(0.0, 0.0, 0.0)
        if length > real(0.0):
            toward = away * (real(1.0) / length)
            direction = wp.vec3(float(toward[0]), float(toward[1]), float(toward[2]))
        rgb = wp.vec3(0.5, 0.5, 0.5)
        for k in range(wp.static(max(sh_coefficients, 1))):
            rgb = fma3(basis_value(k, direction), colors[i * sh_coefficients + k], rgb)
        return wp.vec3(wp.max(rgb[0], 0.0), wp.max(rgb[1], 0.0), wp.max(rgb[2], 0.0))

    return harmonic if sh_coefficients else plain
