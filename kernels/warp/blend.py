"""Tiles from their lists: a block of threads per tile on a GPU; on a CPU a thread per tile that walks each
splat's box within it.
The same functions see every sample, so both take the same decisions.
"""

from functools import cache

import warp as wp

from .bounds import Bounds, make_bounds
from .common import STRICT, View, lowest, store_line
from .pixel import make_pixel
from .staging import BLOCK_W, STAGED

NONE, ONE = wp.constant(wp.uint32(0)), wp.constant(wp.uint32(1))


def strip_of(effects: tuple[str, ...]) -> int:
    """Samples in a row that one GPU thread draws: two share the reading of a record. Pending layers leave no
    registers for that.
    """
    return 1 if "compose_planes" in effects else 2


@cache
def make_blend(effects: tuple[str, ...], on_gpu: bool):
    """The kernel for these effects of splats and samples."""
    strip = strip_of(effects)
    several = strip == 2
    lanes = BLOCK_W // strip  # of a warp, in a row of samples
    block_h = 32 // lanes
    parts = make_pixel(effects, block_h)
    pool, stage, touched = parts.staging.pool, parts.staging.stage, parts.staging.touched
    load_staged = parts.load_staged
    Pixel = parts.Pixel
    limits = make_bounds("lowpass_screen" in effects)
    depth, median, normal, label = (name in effects for name in ("depth", "depth_median", "normal", "label"))
    load, start, row_of, cross, unfinished, blend_one = (
        parts.load,
        parts.start,
        parts.row,
        parts.cross,
        parts.unfinished,
        parts.blend,
    )
    finish = parts.finish

    @wp.func
    def store(
        p: Pixel,
        at: int,
        raw: wp.array(dtype=wp.vec4),
        raw_depth: wp.array(dtype=wp.vec2),
        raw_median: wp.array(dtype=wp.float32),
        raw_normal: wp.array(dtype=wp.vec3),
        raw_label: wp.array(dtype=wp.int32),
        raw_label_weight: wp.array(dtype=wp.float32),
    ):
        store_line(raw, at, wp.vec4(p.r, p.g, p.b, p.t))
        if wp.static(depth):
            raw_depth[at] = wp.vec2(p.depth, p.depth_weight)
        if wp.static(median):
            raw_median[at] = p.depth_median
        if wp.static(normal):
            raw_normal[at] = p.normal
        if wp.static(label):
            raw_label[at] = p.label
            raw_label_weight[at] = p.label_weight

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def blend_gpu(
        band_first: int,  # tile of block 0
        view: View,
        lines: wp.array(dtype=wp.vec4),
        labels: wp.array(dtype=wp.int32),
        planes: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        raw: wp.array(dtype=wp.vec4),  # out, as all below: r, g, b, transmittance
        raw_depth: wp.array(dtype=wp.vec2),  # sum w z, sum w
        raw_median: wp.array(dtype=wp.float32),
        raw_normal: wp.array(dtype=wp.vec3),
        raw_label: wp.array(dtype=wp.int32),
        raw_label_weight: wp.array(dtype=wp.float32),
    ):
        thread = wp.tid()
        threads = view.tile_w * view.tile_h / strip
        tile = band_first + thread / threads
        item = thread % threads
        # a warp draws a block, so that a splat that misses it costs it nothing
        block, lane = item / 32, item % 32
        across = view.tile_w / BLOCK_W
        left = (tile % view.tiles_x) * view.tile_w + (block % across) * BLOCK_W
        top = (tile / view.tiles_x) * view.tile_h + (block / across) * block_h
        x0 = left + (lane % lanes) * strip
        y0 = top + lane / lanes
        p0, p1 = start(), start()
        # what lies beyond the picture is finished from the start
        if y0 >= view.height or x0 >= view.width:
            p0.t = 0.0
        if y0 >= view.height or x0 + 1 >= view.width or wp.static(not several):
            p1.t = 0.0
        records = pool()
        k = starts[tile]
        end = starts[tile + 1]
        while k < end:
            length = wp.min(end - k, STAGED)
            if not stage(records, lines, lists, k, length, unfinished(p0, view) or unfinished(p1, view)):
                break
            word = int(0)
            while 32 * word < length:
                bits = touched(
                    records, word, length, left, top, unfinished(p0, view) or unfinished(p1, view)
                )
                while bits != NONE:
                    which = 32 * word + lowest(bits)
                    bits = bits & (bits - ONE)
                    s = load_staged(records, lines, lists, k, which, view)
                    index = lists[k + which]
                    x = float(x0) - s.d[3]
                    y = float(y0) - s.c[0]
                    u, v, d = row_of(s.u, y), row_of(s.v, y), row_of(s.d, y)
                    if unfinished(p0, view):
                        c0 = cross(s, u, v, d, x, y, view)
                        if c0.drawn:
                            p0 = blend_one(p0, s, c0, index, lines, labels, planes, view)
                    if wp.static(several):
                        if unfinished(p1, view):
                            c1 = cross(s, u, v, d, x + 1.0, y, view)
                            if c1.drawn:
                                p1 = blend_one(p1, s, c1, index, lines, labels, planes, view)
                word += 1
            k += length
        at = y0 * view.tiles_x * view.tile_w + x0
        store(finish(p0, view), at, raw, raw_depth, raw_median, raw_normal, raw_label, raw_label_weight)
        if wp.static(several):
            store(
                finish(p1, view), at + 1, raw, raw_depth, raw_median, raw_normal, raw_label, raw_label_weight
            )

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def blend_cpu(
        band_first: int,  # tile of thread 0
        view: View,
        lines: wp.array(dtype=wp.vec4),
        labels: wp.array(dtype=wp.int32),
        planes: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        raw: wp.array(dtype=wp.vec4),
        raw_depth: wp.array(dtype=wp.vec2),
        raw_median: wp.array(dtype=wp.float32),
        raw_normal: wp.array(dtype=wp.vec3),
        raw_label: wp.array(dtype=wp.int32),
        raw_label_weight: wp.array(dtype=wp.float32),
        bounds: wp.array(dtype=Bounds),
        state: wp.array(
            dtype=Pixel
        ),  # the samples of one tile, from `state_first`: tiles of a launch come one after the other
        state_first: int,
    ):
        tile = band_first + wp.tid()
        x0 = (tile % view.tiles_x) * view.tile_w
        y0 = (tile / view.tiles_x) * view.tile_h
        for k in range(view.tile_w * view.tile_h):
            state[state_first + k] = start()
        x_end = wp.min(x0 + view.tile_w, view.width)
        y_end = wp.min(y0 + view.tile_h, view.height)
        alive = (x_end - x0) * (y_end - y0)
        k = starts[tile]
        end = starts[tile + 1]
        while k < end and alive > 0:
            index = lists[k]
            k += 1
            s = load(lines, index, view)
            b = bounds[index]
            top, bottom = limits.rows(b, view.height)
            top, bottom = wp.max(top, y0), wp.min(bottom, y_end)
            left, right = limits.span(b, top, bottom, view.width)
            left, right = wp.max(left, x0), wp.min(right, x_end)
            for row in range(top, bottom):
                y = float(row) - s.c[0]
                u, v, d = row_of(s.u, y), row_of(s.v, y), row_of(s.d, y)
                for column in range(left, right):
                    c = cross(s, u, v, d, float(column) - s.d[3], y, view)
                    if c.drawn:
                        at = state_first + (row - y0) * view.tile_w + column - x0
                        p = state[at]
                        if unfinished(p, view):
                            p = blend_one(p, s, c, index, lines, labels, planes, view)
                            if not unfinished(p, view):
                                alive -= 1
                            state[at] = p
        stride = view.tiles_x * view.tile_w
        for row in range(view.tile_h):
            for column in range(view.tile_w):
                p = state[state_first + row * view.tile_w + column]
                at = (y0 + row) * stride + x0 + column
                store(
                    finish(p, view), at, raw, raw_depth, raw_median, raw_normal, raw_label, raw_label_weight
                )

    return (blend_gpu if on_gpu else blend_cpu), Pixel
