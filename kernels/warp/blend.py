"""Blending of tiles. On a GPU a block of threads renders a tile: records are staged in shared memory, and
adjacent threads render a cell of 2 x 4 samples, from the staged splats that may overlap it. On a CPU a thread
renders a tile, splat by splat within the splat's box. Both use the same functions of a sample.
"""

from functools import cache

import warp as wp

from . import output
from .bounds import Bounds, make_bounds
from .buffers import make_samples, sample_fields
from .cells import CELL_H, CELL_W, make_cells
from .common import STRICT, View, first_sample, locate_tile, reread, store_vec4
from .intersection import make_intersection
from .pixel import make_pixel
from .rays import RAY_DERIVATIVES
from .records import RecordLayout
from .splat import make_splat
from .staging import STAGED, is_single_thread, make_staging

_PLAIN = frozenset({"lowpass_screen", "stop_exclusive", "arithmetic_fast", "ellipsoids_only"})
_CELL = CELL_W * CELL_H
_NONE, _ONE = wp.constant(wp.uint32(0)), wp.constant(wp.uint32(1))


def samples_per_thread(effects: tuple[str, ...]) -> int:
    """Samples per thread on a GPU: two in a column, for which a record is read once; one with a lens, a
    k-buffer or coplanar layers.
    """
    return 2 if {"rays", "order_pixel", "order_coplanar"}.isdisjoint(effects) else 1


@cache
def make_blend(
    effects: tuple[str, ...], outputs: tuple[str, ...], on_gpu: bool, area: int, k_buffer_size: int
):
    """Make the blend kernel for these effects and outputs; also returns the struct of a sample's state and
    the number of threads of a block on a GPU. area: samples of a tile.
    """
    splats, intersection = make_splat(effects, outputs), make_intersection(effects, outputs)
    per_thread = samples_per_thread(effects)
    threads, items, pair = area // per_thread, _CELL // per_thread, per_thread == 2
    staging = make_staging(RecordLayout(effects, outputs), area // _CELL, items)
    overlapping_cells = make_cells(effects, outputs)
    shared_memory, stage, mark_cells, list_cell, cell_splat = (
        *(staging.shared_memory, staging.stage, staging.mark_cells),
        *(staging.list_cell, staging.cell_splat),
    )
    staged_reader = splats.make_readers(staging.staged_vec4)
    load, box_of, read = staged_reader.load, staged_reader.box_of, splats.read
    column_of, cross, intersect_ray, intersect_derivatives = (
        *(intersection.column, intersection.cross),
        *(intersection.intersect_ray, intersection.intersect_derivatives),
    )
    pixels = make_pixel(effects, outputs, k_buffer_size)
    Splat, Rays, Pixel = splats.Splat, pixels.Rays, pixels.Pixel
    start, unfinished = pixels.start, pixels.unfinished
    blend_one, end_pass, cover, finish = pixels.blend, pixels.end, pixels.cover, pixels.finish
    repeats, has_external_depth, branchless = end_pass is not None, cover is not None, pixels.branchless
    limits = make_bounds("lowpass_screen" in effects)
    Samples = make_samples(tuple(sample_fields(outputs).items()))
    stores, words = output.functions(outputs, "store"), output.digest(outputs)
    Intersection, alpha_of = intersection.Intersection, intersection.alpha_of
    has_fragment_functions = bool(output.having(outputs, "fragment"))
    fragments, has_lowpass_disc = output.functions(outputs, "fragment"), "lowpass_screen" in effects
    has_lens, has_ray_derivatives, has_layers = (
        "rays" in effects,
        intersect_derivatives is not None,
        "order_coplanar" in effects,
    )

    @wp.func
    def store(p: Pixel, at: int, samples: Samples):
        store_vec4(samples.color, at, wp.vec4(p.r, p.g, p.b, p.t))
        for k in range(wp.static(len(stores))):
            wp.static(stores[k])(p, at, samples)

    @wp.func
    def new_sample(x: int, y: int, number: int, rays: Rays, view: View):
        """Initial state of a sample; a sample outside the image is finished."""
        p = start(x, y, number, rays, view)
        if x >= view.width or y >= view.height:
            p.t = 0.0
        return p

    @wp.func
    def has_groups(
        first: int,
        end: int,
        lists: wp.array(dtype=wp.int32),
        coplanar_groups: wp.array(dtype=wp.int32),
        view: View,
    ) -> int:
        """1 for a tile with splats of coplanar groups, which are first in its list; else 0."""
        exist = int(0)
        if first < end:
            if coplanar_groups[lists[first] % view.splats] >= 0:
                exist = 1
        return exist

    @wp.func
    def call_fragment_functions(pixel: Pixel, s: Splat, c: Intersection, x: float, y: float, view: View):
        """Call the `fragment` functions of outputs for a listed splat before it is composited."""
        p, disc, alpha = pixel, float(wp.inf), float(0.0)
        if wp.static(has_lowpass_disc):
            disc = c.lowpass_half_rho
        if c.contributes:
            alpha = alpha_of(s, c, 1.0 / c.d, view)
        for k in range(wp.static(len(fragments))):
            p = wp.static(fragments[k])(p, s, c, x, y, disc, alpha, view)
        return p

    @wp.func
    def intersect(
        s: Splat,
        column: wp.vec3,
        ray: wp.vec3,
        ray_derivatives: RAY_DERIVATIVES,
        x: float,
        y: float,
        view: View,
    ):
        if wp.static(has_ray_derivatives):
            return intersect_derivatives(s, ray, ray_derivatives, x, y, view)
        elif wp.static(has_lens):
            return intersect_ray(s, ray, x, y, view)
        else:
            return cross(s, column[0], column[1], column[2], x, y, view)

    @wp.func
    def blend_splat(
        pixel: Pixel,
        s: Splat,
        column: wp.vec3,  # terms of the three forms that depend on the column only
        ray: wp.vec3,
        ray_derivatives: RAY_DERIVATIVES,
        x: float,  # position relative to the anchor
        y: float,
        position: int,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        coplanar_groups: wp.array(dtype=wp.int32),
        view: View,
    ):
        """Blend the splat at `position` in the list."""
        p = pixel
        if wp.static(branchless):
            c = intersect(s, column, ray, ray_derivatives, x, y, view)
            p = blend_one(p, s, c, position, records, lists, coplanar_groups, view)
        elif unfinished(p, view):
            c = intersect(s, column, ray, ray_derivatives, x, y, view)
            if wp.static(has_fragment_functions):
                p = call_fragment_functions(p, s, c, x, y, view)
            if c.contributes:
                p = blend_one(p, s, c, position, records, lists, coplanar_groups, view)
        return p

    # 768 threads at once: at most 80 registers, enough for two samples without other outputs
    launched = (threads, 768 // threads) if not outputs and _PLAIN.issuperset(effects) else threads
    options = {"module": "unique", "module_options": STRICT, "enable_backward": False}

    @wp.kernel(name=f"blend_gpu_{words}", launch_bounds=launched, **options)
    def blend_gpu(
        first_tile: int,
        tile_order: wp.array(dtype=wp.int32),  # tile of block 0 at first_tile
        views: wp.array(dtype=View),
        rays: Rays,
        records: wp.array(dtype=wp.vec4),
        coplanar_groups: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        samples: Samples,  # out
    ):
        thread = wp.tid()
        tile = tile_order[first_tile + thread / threads]
        item = thread % threads
        number, tile_column, tile_row = locate_tile(tile, views)
        view = views[reread(number)]
        left, top = tile_column * view.tile_w, tile_row * view.tile_h
        # a warp renders `per_thread` rows of four cells
        warp, lane = item / 32, item % 32
        across, own = view.tile_w / (4 * CELL_W), lane % items
        cell_x = warp % across * 4 + lane / items % 4
        cell_y = warp / across * per_thread + lane / items / 4
        cell = cell_y * (4 * across) + cell_x
        x0 = left + cell_x * CELL_W + own % CELL_W
        y0 = top + cell_y * CELL_H + own / CELL_W * per_thread
        p = new_sample(x0, y0, number, rays, view)
        end = starts[tile + 1]
        if wp.static(has_layers):
            p.layers.exist = has_groups(starts[tile], end, lists, coplanar_groups, view)
        alive = unfinished(p, view)
        if wp.static(pair):
            q = new_sample(x0, y0 + 1, number, rays, view)
            alive = alive or unfinished(q, view)
        ray, ray_derivatives = wp.vec3(), RAY_DERIVATIVES()
        if wp.static(has_lens):
            if p.t > 0.0:
                ray = rays.rays[y0 * view.width + x0]
        if wp.static(has_ray_derivatives):
            if p.t > 0.0:
                ray_derivatives = rays.ray_derivatives[y0 * view.width + x0]
        shared = shared_memory()
        again = bool(True)
        while again:
            k = starts[tile]
            while k < end:
                length = wp.min(end - k, STAGED)
                if not stage(shared, records, lists, k, length, alive):
                    break
                view = views[reread(number)]
                word = warp
                while 32 * word < length:
                    which = 32 * word + lane
                    for group in range(wp.static(-(-area // (32 * _CELL)))):
                        cells = _NONE
                        if which < length:
                            s = load(shared, records, lists, k, which, view)
                            cells = overlapping_cells(
                                s, box_of(shared, records, lists, k, which), left, top, group, view
                            )
                        mark_cells(shared, word, group, cells)
                    word += wp.static(threads // 32)
                view = views[reread(number)]
                count = list_cell(shared, length, cell)
                if not alive:
                    count = 0
                for n in range(count):
                    which = cell_splat(shared, cell, n)
                    s = load(shared, records, lists, k, which, view)
                    if is_single_thread():
                        box = box_of(shared, records, lists, k, which)
                        cells = overlapping_cells(s, box, left, top, cell / 32, view)
                        if (cells >> wp.uint32(cell % 32) & _ONE) == _NONE:
                            continue
                    x, y = float(x0) - s.d[3], float(y0) - s.c[0]
                    column = wp.vec3(column_of(s.u, x), column_of(s.v, x), column_of(s.d, x))
                    at = k + which
                    p = blend_splat(
                        p, s, column, ray, ray_derivatives, x, y, at, records, lists, coplanar_groups, view
                    )
                    if wp.static(pair):
                        q = blend_splat(
                            q,
                            s,
                            column,
                            ray,
                            ray_derivatives,
                            x,
                            y + 1.0,
                            at,
                            records,
                            lists,
                            coplanar_groups,
                            view,
                        )
                alive = unfinished(p, view)
                if wp.static(pair):
                    alive = alive or unfinished(q, view)
                k += length
            again = False
            if wp.static(repeats):
                p = end_pass(p, records, lists, view)
                alive = unfinished(p, view)
                again = stage(shared, records, lists, end, 0, alive)
        number, tile_column, tile_row = locate_tile(tile, views)
        view = views[reread(number)]
        at = first_sample(number, view) + y0 * view.tiles_x * view.tile_w + x0
        if wp.static(has_external_depth):
            p = cover(p, x0, y0, number, rays, view)
        store(finish(p), at, samples)
        if wp.static(pair):
            if wp.static(has_external_depth):
                q = cover(q, x0, y0 + 1, number, rays, view)
            store(finish(q), at + view.tiles_x * view.tile_w, samples)

    @wp.kernel(name=f"blend_cpu_{words}", **options)
    def blend_cpu(
        first_tile: int,  # tile of thread 0
        views: wp.array(dtype=View),
        rays: Rays,
        records: wp.array(dtype=wp.vec4),
        coplanar_groups: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        samples: Samples,  # out
        bounds: wp.array(dtype=Bounds),
        state: wp.array(dtype=Pixel),  # samples of one tile from `state_first` on; scratch
        state_first: int,
    ):
        tile = first_tile + wp.tid()
        number, tile_column, tile_row = locate_tile(tile, views)
        view = views[number]
        x0 = tile_column * view.tile_w
        y0 = tile_row * view.tile_h
        end = starts[tile + 1]
        exist = int(0)
        if wp.static(has_layers):
            exist = has_groups(starts[tile], end, lists, coplanar_groups, view)
        for k in range(view.tile_w * view.tile_h):
            p = start(x0 + k % view.tile_w, y0 + k / view.tile_w, number, rays, view)
            if wp.static(has_layers):
                p.layers.exist = exist
            state[state_first + k] = p
        x_end = wp.min(x0 + view.tile_w, view.width)
        y_end = wp.min(y0 + view.tile_h, view.height)
        alive = (x_end - x0) * (y_end - y0)
        again = bool(True)
        while again:
            k = starts[tile]
            while k < end and alive > 0:
                index = lists[k]
                s = read(records, lists, k, view)
                k += 1
                b = bounds[index]
                top, bottom = limits.rows(b, view.height)
                top, bottom = wp.max(top, y0), wp.min(bottom, y_end)
                left, right = limits.span(b, top, bottom, view.width)
                left, right = wp.max(left, x0), wp.min(right, x_end)
                for column in range(left, right):
                    x = float(column) - s.d[3]
                    u, v, d = column_of(s.u, x), column_of(s.v, x), column_of(s.d, x)
                    for row in range(top, bottom):
                        y = float(row) - s.c[0]
                        if wp.static(has_ray_derivatives):
                            at = row * view.width + column
                            c = intersect_derivatives(s, rays.rays[at], rays.ray_derivatives[at], x, y, view)
                        elif wp.static(has_lens):
                            c = intersect_ray(s, rays.rays[row * view.width + column], x, y, view)
                        else:
                            c = cross(s, u, v, d, x, y, view)
                        if wp.static(has_fragment_functions):
                            at = state_first + (row - y0) * view.tile_w + column - x0
                            if unfinished(state[at], view):
                                state[at] = call_fragment_functions(state[at], s, c, x, y, view)
                        if c.contributes:
                            at = state_first + (row - y0) * view.tile_w + column - x0
                            p = state[at]
                            if unfinished(p, view):
                                p = blend_one(p, s, c, k - 1, records, lists, coplanar_groups, view)
                                if not unfinished(p, view):
                                    alive -= 1
                                state[at] = p
            again = False
            if wp.static(repeats):
                alive = int(0)
                for at in range(state_first, state_first + view.tile_w * view.tile_h):
                    p = end_pass(state[at], records, lists, view)
                    if unfinished(p, view):
                        alive += 1
                    state[at] = p
                again = alive > 0
        stride = view.tiles_x * view.tile_w
        corner = first_sample(number, view) + y0 * stride + x0
        for down in range(view.tile_h):
            for across in range(view.tile_w):
                p = state[state_first + down * view.tile_w + across]
                if wp.static(has_external_depth):
                    p = cover(p, x0 + across, y0 + down, number, rays, view)
                at = corner + down * stride + across
                store(finish(p), at, samples)

    return (blend_gpu if on_gpu else blend_cpu), Pixel, threads
