"""Tiles from their lists: on a GPU a block of threads per tile, a sample per thread, records staged in shared
memory; on a CPU a thread per tile that walks each splat's box within it.
The same functions see every sample, so both take the same decisions.
"""

from functools import cache

import warp as wp

from . import output
from .bounds import Bounds, make_bounds
from .buffers import make_samples, sample_fields
from .common import STRICT, View, first_sample, lowest, place_of, reread, store_line
from .crossing import make_crossing
from .pixel import make_pixel
from .rays import SLOPES
from .splat import make_splat
from .staging import BLOCK_H, BLOCK_W, STAGED

_PLAIN = frozenset({"lowpass_screen", "stop_exclusive", "arithmetic_fast"})
NONE, ONE = wp.constant(wp.uint32(0)), wp.constant(wp.uint32(1))


@cache
def make_blend(effects: tuple[str, ...], outputs: tuple[str, ...], on_gpu: bool, threads: int, room: int):
    """The kernel for these effects of splats and samples, and these outputs, and the struct that a sample
    keeps; threads: of a block on a GPU, one for each of a tile's samples; room: for fragments that wait.
    """
    splats, crossing = make_splat(effects, outputs), make_crossing(effects, outputs)
    pool, stage, touched = splats.staging.pool, splats.staging.stage, splats.staging.touched
    load = splats.load
    row_of, cross, cross_ray, cross_slopes = (
        *(crossing.row, crossing.cross),
        *(crossing.cross_ray, crossing.cross_slopes),
    )
    pixels = make_pixel(effects, outputs, room)
    Rays, Pixel, start, unfinished = pixels.Rays, pixels.Pixel, pixels.start, pixels.unfinished
    blend_one, end_pass, cover, finish = pixels.blend, pixels.end, pixels.cover, pixels.finish
    repeats, opaque = end_pass is not None, cover is not None
    limits = make_bounds("lowpass_screen" in effects)
    Samples = make_samples(tuple(sample_fields(outputs).items()))
    stores, mark = output.functions(outputs, "store"), output.digest(outputs)
    bent, curved = "rays" in effects, cross_slopes is not None

    @wp.func
    def store(p: Pixel, at: int, samples: Samples):
        store_line(samples.color, at, wp.vec4(p.r, p.g, p.b, p.t))
        for k in range(wp.static(len(stores))):
            wp.static(stores[k])(p, at, samples)

    # so many threads at once: at most 40 registers, which is what a sample takes that keeps only its light
    launched = (threads, 1536 // threads) if not outputs and _PLAIN.issuperset(effects) else threads
    options = {"module": "unique", "module_options": STRICT, "enable_backward": False}

    @wp.kernel(name=f"blend_gpu_{mark}", launch_bounds=launched, **options)
    def blend_gpu(
        band_first: int,  # tile of block 0
        views: wp.array(dtype=View),
        rays: Rays,
        lines: wp.array(dtype=wp.vec4),
        planes: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        samples: Samples,  # out
    ):
        thread = wp.tid()
        tile = band_first + thread / threads
        item = thread % threads
        # a warp draws a block, so that a splat that misses it costs it nothing
        block, lane = item / 32, item % 32
        number, tile_column, tile_row = place_of(tile, views)
        view = views[reread(number)]
        across = view.tile_w / BLOCK_W
        left = tile_column * view.tile_w + (block % across) * BLOCK_W
        top = tile_row * view.tile_h + (block / across) * BLOCK_H
        x0 = left + lane % BLOCK_W
        y0 = top + lane / BLOCK_W
        p = start(x0, y0, rays, view)
        if x0 >= view.width or y0 >= view.height:
            p.t = 0.0  # what lies beyond the picture is finished from the start
        if wp.static(bent):
            ray = wp.vec3()
            if p.t > 0.0:
                ray = rays.rays[y0 * view.width + x0]
        if wp.static(curved):
            slopes = SLOPES()
            if p.t > 0.0:
                slopes = rays.slopes[y0 * view.width + x0]
        records = pool()
        end = starts[tile + 1]
        again = bool(True)
        while again:
            k = starts[tile]
            while k < end:
                length = wp.min(end - k, STAGED)
                if not stage(records, lines, lists, k, length, unfinished(p, view)):
                    break
                word = int(0)
                while 32 * word < length:
                    bits = touched(records, word, length, left, top, unfinished(p, view))
                    while bits != NONE:
                        which = 32 * word + lowest(bits)
                        bits = bits & (bits - ONE)
                        s = load(records, lines, lists, k, which, view)
                        if unfinished(p, view):
                            x, y = float(x0) - s.d[3], float(y0) - s.c[0]
                            if wp.static(curved):
                                c = cross_slopes(s, ray, slopes, x, y, view)
                            elif wp.static(bent):
                                c = cross_ray(s, ray, x, y, view)
                            else:
                                c = cross(s, row_of(s.u, y), row_of(s.v, y), row_of(s.d, y), x, y, view)
                            if c.drawn:
                                p = blend_one(p, s, c, k + which, lines, lists, planes, view)
                    word += 1
                k += length
            again = False
            if wp.static(repeats):
                p = end_pass(p, lines, lists, view)
                again = stage(records, lines, lists, end, 0, unfinished(p, view))
        if wp.static(opaque):
            p = cover(p, x0, y0, rays, view)
        number, tile_column, tile_row = place_of(tile, views)
        view = views[reread(number)]
        at = first_sample(number, view) + y0 * view.tiles_x * view.tile_w + x0
        store(finish(p), at, samples)

    @wp.kernel(name=f"blend_cpu_{mark}", **options)
    def blend_cpu(
        band_first: int,  # tile of thread 0
        views: wp.array(dtype=View),
        rays: Rays,
        lines: wp.array(dtype=wp.vec4),
        planes: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        samples: Samples,  # out
        bounds: wp.array(dtype=Bounds),
        state: wp.array(
            dtype=Pixel
        ),  # the samples of one tile, from `state_first`: tiles of a launch come one after the other
        state_first: int,
    ):
        tile = band_first + wp.tid()
        number, tile_column, tile_row = place_of(tile, views)
        view = views[number]
        x0 = tile_column * view.tile_w
        y0 = tile_row * view.tile_h
        for k in range(view.tile_w * view.tile_h):
            state[state_first + k] = start(x0 + k % view.tile_w, y0 + k / view.tile_w, rays, view)
        x_end = wp.min(x0 + view.tile_w, view.width)
        y_end = wp.min(y0 + view.tile_h, view.height)
        alive = (x_end - x0) * (y_end - y0)
        end = starts[tile + 1]
        again = bool(True)
        while again:
            k = starts[tile]
            while k < end and alive > 0:
                index = lists[k]
                s = load(wp.uint64(0), lines, lists, k, 0, view)
                k += 1
                b = bounds[index]
                top, bottom = limits.rows(b, view.height)
                top, bottom = wp.max(top, y0), wp.min(bottom, y_end)
                left, right = limits.span(b, top, bottom, view.width)
                left, right = wp.max(left, x0), wp.min(right, x_end)
                for row in range(top, bottom):
                    y = float(row) - s.c[0]
                    u, v, d = row_of(s.u, y), row_of(s.v, y), row_of(s.d, y)
                    for column in range(left, right):
                        x = float(column) - s.d[3]
                        if wp.static(curved):
                            at = row * view.width + column
                            c = cross_slopes(s, rays.rays[at], rays.slopes[at], x, y, view)
                        elif wp.static(bent):
                            c = cross_ray(s, rays.rays[row * view.width + column], x, y, view)
                        else:
                            c = cross(s, u, v, d, x, y, view)
                        if c.drawn:
                            at = state_first + (row - y0) * view.tile_w + column - x0
                            p = state[at]
                            if unfinished(p, view):
                                p = blend_one(p, s, c, k - 1, lines, lists, planes, view)
                                if not unfinished(p, view):
                                    alive -= 1
                                state[at] = p
            again = False
            if wp.static(repeats):
                alive = int(0)
                for at in range(state_first, state_first + view.tile_w * view.tile_h):
                    p = end_pass(state[at], lines, lists, view)
                    if unfinished(p, view):
                        alive += 1
                    state[at] = p
                again = alive > 0
        stride = view.tiles_x * view.tile_w
        corner = first_sample(number, view) + y0 * stride + x0
        for down in range(view.tile_h):
            for across in range(view.tile_w):
                p = state[state_first + down * view.tile_w + across]
                if wp.static(opaque):
                    p = cover(p, x0 + across, y0 + down, rays, view)
                at = corner + down * stride + across
                store(finish(p), at, samples)

    return (blend_gpu if on_gpu else blend_cpu), Pixel
