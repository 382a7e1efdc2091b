"""Resolve stage: average samples to pixels, composite rgb over the background, resolve outputs (output/)."""

from functools import cache

import warp as wp

from . import output
from .buffers import make_images, make_samples, sample_fields
from .common import STRICT, View, first_sample, fma3
from .pixel_grid import PixelGrid, sample_at
from .rays import make_rays


@cache
def make_resolve(
    images: tuple[tuple[str, type], ...], outputs: tuple[str, ...], has_ray_lengths: bool, samples: int
):
    """Make the resolve kernel for output images and outputs, with samples x samples per pixel.
    has_ray_lengths: whether ray lengths are read from the buffer of a lens.
    """
    Samples, Images = make_samples(tuple(sample_fields(outputs).items())), make_images(images, outputs)
    rays = make_rays(has_ray_lengths, has_ray_lengths)
    Rays, length_of = rays.Rays, rays.length_of
    requested = {name for name, _ in images}
    names = [name for name in outputs if name in requested]
    over = [name for name in outputs if output.declared(name).over in requested]
    resolving = output.having([*names, *over], "resolve")
    resolves, background_shares = (
        output.functions(resolving, "resolve"),
        output.functions(outputs, "background_share"),
    )
    measured = bool(output.having(resolving, "length"))
    n = samples
    mean = 1.0 / (n * n)
    lengths_type = wp.types.vector(n * n, wp.float32)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def resolve(
        first_pixel: int,  # pixel of thread 0; pixels are numbered view after view, row by row
        views: wp.array(dtype=View),
        batch_indices: wp.array(dtype=wp.int32),  # (views) index of each view in the images
        background: wp.vec3,
        rays: Rays,
        samples: Samples,
        out: Images,
    ):
        position = wp.tid() + first_pixel
        view = views[0]
        width = view.width / n
        pixels = width * (view.height / n)
        number = position / pixels
        view = views[number]
        grid = PixelGrid()
        here = position - number * pixels
        grid.here = position
        grid.pixel = batch_indices[number] * pixels + here
        own_row = here / width
        grid.row = number * (view.height / n) + own_row
        grid.splats = view.splats
        x = (here % width) * n
        y = own_row * n
        grid.stride = view.tiles_x * view.tile_w
        grid.first = first_sample(number, view) + y * grid.stride + x
        grid.side = n
        grid.count = wp.static(n * n)
        grid.mean = mean
        total = wp.vec4()
        lengths = lengths_type()
        for k in range(grid.count):
            total += samples.color[sample_at(grid, k)]
            if wp.static(measured):
                lengths[k] = length_of(x + k % n, y + k / n, rays, view)
        left = total[3] * mean
        rgb = fma3(left, background, wp.vec3(total[0] * mean, total[1] * mean, total[2] * mean))
        for k in range(wp.static(len(background_shares))):
            rgb = fma3(wp.static(background_shares[k])(grid, samples), background, rgb)
        for channel in range(3):
            out.rgb[3 * grid.pixel + channel] = rgb[channel]
        for k in range(wp.static(len(resolves))):
            wp.static(resolves[k])(grid, samples, lengths, out)

    return resolve
