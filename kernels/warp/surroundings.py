"""What is seen behind everything, and the rays that it takes: one colour, a gradient, a panorama."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .common import View, fma, struct_of

TURN = wp.constant(0.15915494309189535)
"""1 / (2 pi)"""

KINDS = {
    "constant": {"color": wp.vec3},
    "gradient": {"top": wp.vec3, "bottom": wp.vec3, "up": wp.vec3},
    "panorama": {"image": wp.array2d(dtype=wp.vec3)},
}


@wp.func
def ray_at(x: float, y: float, view: View) -> wp.vec3:
    """The ray through a point of the sample grid, of a length of 1 along z; straight ahead where depths are
    distances already.
    """
    ray = view.ray
    return wp.vec3((x - ray[2]) * ray[0], (y - ray[3]) * ray[1], 1.0)


@wp.func
def ray_length(x: float, y: float, view: View) -> float:
    """What turns depths at a point of the sample grid into distances."""
    return wp.length(ray_at(x, y, view))


@wp.func
def to_world(direction: wp.vec3, view: View) -> wp.vec3:
    """A direction of the camera in the axes of the world."""
    return wp.transpose(wp.mat33(view.rotation)) * direction


@cache
def make_surroundings(kind: str) -> SimpleNamespace:
    """Around, the numbers of this kind of background; behind(around, x, y, view), its colour in the direction
    of a point of the sample grid.
    """
    Around = struct_of("Around", "What lies behind everything.", KINDS[kind])

    @wp.func
    def constant(around: Around, x: float, y: float, view: View) -> wp.vec3:
        return around.color

    @wp.func
    def gradient(around: Around, x: float, y: float, view: View) -> wp.vec3:
        """By the sine of the ray's height above the horizon."""
        ray = to_world(ray_at(x, y, view), view)
        share = wp.clamp(0.5 + 0.5 * wp.dot(ray, around.up) / wp.length(ray), 0.0, 1.0)
        return around.bottom + share * (around.top - around.bottom)

    @wp.func
    def pixel_of(around: Around, column: int, row: int) -> wp.vec3:
        """Round the seam, and the first and last row for what lies beyond them."""
        height, width = around.image.shape[0], around.image.shape[1]
        return around.image[wp.clamp(row, 0, height - 1), (column + width) % width]

    @wp.func
    def panorama(around: Around, x: float, y: float, view: View) -> wp.vec3:
        """Bilinear; the middle column lies towards +z, to the right of it is +x, the top row is -y."""
        ray = to_world(ray_at(x, y, view), view)
        flat = wp.sqrt(fma(ray[0], ray[0], ray[2] * ray[2]))
        height, width = float(around.image.shape[0]), float(around.image.shape[1])
        u = fma(fma(wp.atan2(ray[0], ray[2]), TURN, 0.5), width, -0.5)
        v = fma(fma(wp.atan2(ray[1], flat), 2.0 * TURN, 0.5), height, -0.5)
        column, row = int(wp.floor(u)), int(wp.floor(v))
        across, down = u - wp.floor(u), v - wp.floor(v)
        above = wp.lerp(pixel_of(around, column, row), pixel_of(around, column + 1, row), across)
        below = wp.lerp(pixel_of(around, column, row + 1), pixel_of(around, column + 1, row + 1), across)
        return wp.lerp(above, below, down)

    kinds = {"constant": constant, "gradient": gradient, "panorama": panorama}
    return SimpleNamespace(Around=Around, behind=kinds[kind])
