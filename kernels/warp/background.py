"""Background of each sample by the direction of its ray: a gradient or a panorama. A constant colour is added
when samples are resolved.
"""

from functools import cache

import warp as wp

from .common import STRICT, View, first_sample, fma, fma3, fma_dot, store_vec4, struct_of
from .rays import make_rays

TURN = wp.constant(0.15915494309189535)
"""1 / (2 pi)"""

KINDS = {
    "gradient": {"top": wp.vec3, "bottom": wp.vec3, "up": wp.vec3},
    "panorama": {"image": wp.array2d(dtype=wp.vec3)},
}


@cache
def struct_of_environment(kind: str):
    """Struct of the parameters of a background: `gradient` or `panorama`."""
    return struct_of("Environment", "The background.", KINDS[kind])


@cache
def make_composite_background(kind: str, has_lens: bool):
    """Make the kernel that adds a background to the samples. kind: `gradient` or `panorama`. has_lens:
    whether the camera has a lens."""
    Environment, rays = struct_of_environment(kind), make_rays(has_lens)
    Rays, ray_of = rays.Rays, rays.ray_of

    @wp.func
    def gradient(environment: Environment, ray: wp.vec3) -> wp.vec3:
        """Gradient by the sine of the ray's elevation above the horizon."""
        share = wp.clamp(fma(0.5, fma_dot(ray, environment.up) / wp.sqrt(fma_dot(ray, ray)), 0.5), 0.0, 1.0)
        return fma3(share, environment.top - environment.bottom, environment.bottom)

    @wp.func
    def pixel_of(environment: Environment, column: int, row: int) -> wp.vec3:
        """Pixel of the panorama: columns wrap around, rows are clamped."""
        height, width = environment.image.shape[0], environment.image.shape[1]
        return environment.image[wp.clamp(row, 0, height - 1), (column + width) % width]

    @wp.func
    def panorama(environment: Environment, ray: wp.vec3) -> wp.vec3:
        """Bilinear lookup; the middle column is +z, the column right of it towards +x, the top row is -y."""
        flat = wp.sqrt(fma(ray[0], ray[0], ray[2] * ray[2]))
        height, width = float(environment.image.shape[0]), float(environment.image.shape[1])
        u = fma(fma(wp.atan2(ray[0], ray[2]), TURN, 0.5), width, -0.5)
        v = fma(fma(wp.atan2(ray[1], flat), 2.0 * TURN, 0.5), height, -0.5)
        column, row = int(wp.floor(u)), int(wp.floor(v))
        across, down = u - wp.floor(u), v - wp.floor(v)
        above = between(environment, column, row, across)
        return fma3(down, between(environment, column, row + 1, across) - above, above)

    @wp.func
    def between(environment: Environment, column: int, row: int, share: float) -> wp.vec3:
        left, right = pixel_of(environment, column, row), pixel_of(environment, column + 1, row)
        return fma3(share, right - left, left)

    behind = {"gradient": gradient, "panorama": panorama}[kind]

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def composite_background(
        first: int,  # sample of thread 0; samples are numbered view after view, row by row
        views: wp.array(dtype=View),
        environment: Environment,
        rays: Rays,
        color: wp.array(dtype=wp.vec4),  # in and out: r, g, b, transmittance
    ):
        sample = wp.tid() + first
        view = views[0]
        number = sample / (view.width * view.height)
        view = views[number]
        column, row = sample % view.width, sample / view.width % view.height
        ray = ray_of(column, row, rays, view)
        if ray[0] == ray[0]:
            at = first_sample(number, view) + row * view.tiles_x * view.tile_w + column
            light = color[at]
            # in world axes
            r = wp.transpose(wp.mat33(view.rotation))
            added = behind(environment, wp.vec3(fma_dot(r[0], ray), fma_dot(r[1], ray), fma_dot(r[2], ray)))
            for channel in range(3):
                light[channel] = fma(light[3], added[channel], light[channel])
            store_vec4(color, at, light)

    return composite_background
