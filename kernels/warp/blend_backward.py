"""Backward pass of blending (fragment_backward.py has the formulas).

The list of each tile is evaluated forward again, for the transmittance in front of every SEGMENT splats, then
backward, a segment at a time. For each splat, the sums over the tile's samples are stored at the gradient
buffer offset of this (splat, tile) pair. There are no atomics, so sums have a fixed order and results are
bit-identical on every run.

On a GPU a block of threads processes a tile, one sample per thread; sums are computed over a warp by shuffles
and over the warps in shared memory. On a CPU a thread processes a tile, splat by splat within its bounding
box.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .bounds import Bounds, make_bounds, window_tile
from .common import STRICT, View, lowest, with_numbers
from .fragment_backward import make_fragments

SEGMENT = 32
"""splats of a tile's list that are evaluated forward and then backward together"""
BLOCK_W, BLOCK_H = 8, 4
"""rows and columns of samples of a warp, one sample per thread"""
NONE, ONE = wp.constant(wp.uint32(0)), wp.constant(wp.uint32(1))
_WINDOW, _BITS = wp.constant(wp.uint64(32)), wp.constant(wp.uint64(0xFFFFFFFF))

_ANY_OF_BLOCK = """
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(open);
#else
    return open;
#endif
"""
_ANY_OF_WARP = """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, open);
#else
    return open;
#endif
"""
_SHARED_MEMORY = """
#if defined(__CUDA_ARCH__)
    __shared__ float parts[SEGMENT * WARPS * FIELDS];
    return static_cast<wp::uint64>(__cvta_generic_to_shared(parts));
#else
    return 0;
#endif
"""
# on the CPU the threads of a block run one after another, and add to the sums in a fixed order
_SUM_OVER_WARP = """
#if defined(__CUDA_ARCH__)
    float* parts = reinterpret_cast<float*>(__cvta_shared_to_generic(shared_memory));
    parts += (position * WARPS + threadIdx.x / 32) * FIELDS;
    const int lane = threadIdx.x & 31;
    if (!__any_sync(0xffffffffu, contributes)) {
        if (lane < FIELDS) parts[lane] = 0.0f;
        return;
    }
    for (int field = 0; field < FIELDS; field++) {
        float sum = values[field];
        for (int apart = 16; apart > 0; apart /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, apart);
        if (lane == 0) parts[field] = sum;
    }
#else
    if (contributes)
        for (int field = 0; field < FIELDS; field++) gradient_sums.data[offset][field] += values[field];
#endif
"""
_SUM_OVER_BLOCK = """
#if defined(__CUDA_ARCH__)
    const float* parts = reinterpret_cast<const float*>(__cvta_shared_to_generic(shared_memory));
    __syncthreads();
    for (int cell = threadIdx.x; cell < count * FIELDS; cell += blockDim.x) {
        const int position = cell / FIELDS, field = cell % FIELDS;
        float sum = 0.0f;
        for (int warp = 0; warp < WARPS; warp++) sum += parts[(position * WARPS + warp) * FIELDS + field];
        gradient_sums.data[gradient_offsets.data[first + position]][field] = sum;
    }
    __syncthreads();
#endif
"""


@cache
def make_gradient_offsets(has_lowpass_disc: bool):
    """Make the kernel that computes the gradient buffer offset of each (splat, tile) pair.
    has_lowpass_disc: see `make_bounds`.

    A splat has an offset per tile, in the order of the tiles, after the offsets of preceding splats.
    """
    limits = make_bounds(has_lowpass_disc)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def find_gradient_offsets(
        first: int,
        views: wp.array(dtype=View),  # (1)
        tiles: int,
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        windows: wp.array(dtype=wp.uint64),
        bounds: wp.array(dtype=Bounds),
        counts: wp.array(dtype=wp.int32),
        ends_by_index: wp.array(dtype=wp.int32),  # inclusive sums
        gradient_offsets: wp.array(dtype=wp.int32),  # (pairs) out
    ):
        view = views[0]
        k = first + wp.tid()
        index, tile = lists[k], wp.lower_bound(starts, 0, tiles + 1, k + 1) - 1
        corner = int(windows[index] >> _WINDOW)
        bits = wp.uint32(windows[index] & _BITS)
        rank = int(0)
        if bits == NONE:
            b = bounds[index]
            row, end = limits.tile_rows(b, view)
            while row < end:
                left, right = limits.tile_span(b, row, view)
                base = row * view.tiles_x
                rank += wp.clamp(tile - (left + base), 0, wp.max(right - left, 0))
                row += 1
        while bits != NONE and window_tile(corner, lowest(bits), view) != tile:
            bits = bits & (bits - ONE)
            rank += 1
        gradient_offsets[k] = ends_by_index[index] - counts[index] + rank

    return find_gradient_offsets


@cache
def make_blend_backward(
    effects: tuple[str, ...],
    outputs: tuple[str, ...],
    gradient_outputs: tuple[str, ...],
    on_gpu: bool,
    threads: int,
) -> SimpleNamespace:
    """Make the kernel of the backward pass, and the structs ImageGradients (inputs), PixelGradient (state of
    a sample) and GradientSums (results). effects, outputs, on_gpu, threads: see `make_blend`.
    gradient_outputs: outputs with gradients."""
    made = make_fragments(effects, outputs, gradient_outputs)
    ImageGradients, Samples, PixelGradient, GradientSums = (
        made.ImageGradients,
        made.Samples,
        made.PixelGradient,
        made.GradientSums,
    )
    read, box_of, pixel_gradient_at = made.read, made.box_of, made.pixel_gradient_at
    alpha_at, fragment_gradient = made.alpha_at, made.fragment_gradient
    numbers = {"SEGMENT": SEGMENT, "WARPS": max(threads // 32, 1), "FIELDS": wp.types.type_size(GradientSums)}

    @wp.func_native(with_numbers(_ANY_OF_BLOCK, numbers))
    def any_of_block(open: bool) -> bool:
        """Whether `open` is true in any thread of the block; a barrier."""
        ...

    @wp.func_native(with_numbers(_ANY_OF_WARP, numbers))
    def any_of_warp(open: bool) -> bool:
        """Whether `open` is true in any thread of the warp."""
        ...

    @wp.func_native(with_numbers(_SHARED_MEMORY, numbers))
    def shared_memory() -> wp.uint64:
        """Address in shared memory of the partial sums of each warp."""
        ...

    @wp.func_native(with_numbers(_SUM_OVER_WARP, numbers))
    def sum_over_warp(
        shared_memory: wp.uint64,
        position: int,
        contributes: bool,
        values: GradientSums,
        gradient_sums: wp.array(dtype=GradientSums),
        offset: int,
    ):
        """Sum the values of a fragment over the warp; other threads add 0."""
        ...

    @wp.func_native(with_numbers(_SUM_OVER_BLOCK, numbers))
    def sum_over_block(
        shared_memory: wp.uint64,
        first: int,
        count: int,
        gradient_sums: wp.array(dtype=GradientSums),
        gradient_offsets: wp.array(dtype=wp.int32),
    ):
        """Sum the sums of all warps for `count` splats of the list into the splats' sums; a
        barrier."""
        ...

    segment_of = wp.types.vector(SEGMENT, wp.float32)
    options = {"module": "unique", "module_options": STRICT, "enable_backward": False}

    @wp.func
    def transmittance_behind(transmittance: float, alpha: float) -> float:
        """Transmittance behind a fragment; 0 behind a fragment that terminates the sample (alpha -1)."""
        if alpha < 0.0:
            return 0.0
        return transmittance - transmittance * alpha

    @wp.kernel(launch_bounds=threads, **options)
    def blend_backward_gpu(
        first_tile: int,  # tile of block 0
        views: wp.array(dtype=View),  # (1)
        background: wp.vec3,
        log_ceiling: float,
        records: wp.array(dtype=wp.vec4),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        gradient_offsets: wp.array(dtype=wp.int32),
        image_gradients: ImageGradients,
        samples: Samples,
        checkpoints: wp.array(
            dtype=wp.float32
        ),  # scratch: transmittance in front of every SEGMENT splats of a tile
        gradient_sums: wp.array(dtype=GradientSums),  # out, zeroed by the caller
    ):
        view = views[0]
        thread = wp.tid()
        tile = first_tile + thread / threads
        item = thread % threads
        block, lane = item / 32, item % 32
        across = view.tile_w / BLOCK_W
        left = (tile % view.tiles_x) * view.tile_w + (block % across) * BLOCK_W
        top = (tile / view.tiles_x) * view.tile_h + (block / across) * BLOCK_H
        x, y = left + lane % BLOCK_W, top + lane / BLOCK_W
        pixel_gradient = pixel_gradient_at(x, y, image_gradients, samples, background, view)
        transmittance = float(1.0)
        if x >= view.width or y >= view.height:
            transmittance = 0.0
        start, end = starts[tile], starts[tile + 1]
        own = (start / SEGMENT + tile) * threads + item

        segments = int(0)
        while start + segments * SEGMENT < end and any_of_block(transmittance > view.transmittance_stop):
            first = start + segments * SEGMENT
            checkpoints[own + segments * threads] = transmittance
            for position in range(wp.min(SEGMENT, end - first)):
                box = box_of(records, lists[first + position])
                if box[0] < left + BLOCK_W and box[1] > left and box[2] < top + BLOCK_H and box[3] > top:
                    s = read(records, lists, first + position, view)
                    transmittance = transmittance_behind(
                        transmittance, alpha_at(s, x, y, transmittance, view)
                    )
            segments += 1

        parts = shared_memory()
        while segments > 0:
            segments -= 1
            first = start + segments * SEGMENT
            count = wp.min(SEGMENT, end - first)
            transmittance = checkpoints[own + segments * threads]
            transmittances, alphas = segment_of(), segment_of()
            for position in range(count):
                transmittances[position] = transmittance
                box = box_of(records, lists[first + position])
                if box[0] < left + BLOCK_W and box[1] > left and box[2] < top + BLOCK_H and box[3] > top:
                    s = read(records, lists, first + position, view)
                    alpha = alpha_at(s, x, y, transmittance, view)
                    transmittance = transmittance_behind(transmittance, alpha)
                    alphas[position] = alpha
            position = count
            while position > 0:
                position -= 1
                contributes = alphas[position] > 0.0
                values = GradientSums()
                if any_of_warp(contributes):
                    s = read(records, lists, first + position, view)
                    if contributes:
                        values, pixel_gradient = fragment_gradient(
                            s, lists[first + position], x, y, transmittances[position], alphas[position],
                            pixel_gradient, log_ceiling, records, view,
                        )  # fmt: skip
                sum_over_warp(
                    parts, position, contributes, values, gradient_sums, gradient_offsets[first + position]
                )
            sum_over_block(parts, first, count, gradient_sums, gradient_offsets)

    @wp.func
    def clipped_box(records: wp.array(dtype=wp.vec4), index: int, x0: int, y0: int, view: View) -> wp.vec4i:
        """Box of the tile's samples that the splat may overlap, relative to the tile's first sample (x0,
        y0)."""
        box = box_of(records, index)
        return wp.vec4i(
            wp.max(box[0] - x0, 0),
            wp.min(box[1] - x0, view.tile_w),
            wp.max(box[2] - y0, 0),
            wp.min(box[3] - y0, view.tile_h),
        )

    @wp.func
    def attenuate(
        k: int,
        position: int,
        alive: int,
        x0: int,
        y0: int,
        state_first: int,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        transmittances: wp.array(dtype=wp.float32),
        fragments: wp.array(dtype=wp.vec2),
        view: View,
    ) -> int:
        """Attenuate the samples of a tile by the splat lists[k], and store its fragments; returns the number
        of samples that are not terminated."""
        s = read(records, lists, k, view)
        area = clipped_box(records, lists[k], x0, y0, view)
        left = alive
        for row in range(area[2], area[3]):
            for column in range(area[0], area[1]):
                at = state_first + row * view.tile_w + column
                transmittance = transmittances[at]
                alpha = alpha_at(s, x0 + column, y0 + row, transmittance, view)
                fragments[at * SEGMENT + position] = wp.vec2(transmittance, alpha)
                if alpha != 0.0:
                    transmittances[at] = transmittance_behind(transmittance, alpha)
                    if not (transmittances[at] > view.transmittance_stop):
                        left -= 1
        return left

    @wp.kernel(**options)
    def blend_backward_cpu(
        first_tile: int,  # tile of thread 0
        views: wp.array(dtype=View),  # (1)
        background: wp.vec3,
        log_ceiling: float,
        records: wp.array(dtype=wp.vec4),
        starts: wp.array(dtype=wp.int32),
        lists: wp.array(dtype=wp.int32),
        gradient_offsets: wp.array(dtype=wp.int32),
        image_gradients: ImageGradients,
        samples: Samples,
        checkpoints: wp.array(dtype=wp.float32),
        gradient_sums: wp.array(dtype=GradientSums),  # out, zeroed by the caller
        transmittances: wp.array(
            dtype=wp.float32
        ),  # scratch of one tile from `state_first` on, as in blend_cpu
        pixel_gradients: wp.array(dtype=PixelGradient),  # scratch, as `transmittances`
        fragments: wp.array(dtype=wp.vec2),  # scratch, SEGMENT per sample: transmittance and alpha
        state_first: int,
    ):
        view = views[0]
        tile = first_tile + wp.tid()
        x0 = (tile % view.tiles_x) * view.tile_w
        y0 = (tile / view.tiles_x) * view.tile_h
        area = view.tile_w * view.tile_h
        alive = int(0)
        for k in range(area):
            x, y = x0 + k % view.tile_w, y0 + k / view.tile_w
            pixel_gradients[state_first + k] = pixel_gradient_at(
                x, y, image_gradients, samples, background, view
            )
            transmittances[state_first + k] = 0.0
            if x < view.width and y < view.height:
                transmittances[state_first + k] = 1.0
                alive += 1
        start, end = starts[tile], starts[tile + 1]
        own = (start / SEGMENT + tile) * area
        processed = start
        while processed < end and alive > 0:
            segment, position = (processed - start) / SEGMENT, (processed - start) % SEGMENT
            if position == 0:
                for k in range(area):
                    checkpoints[own + segment * area + k] = transmittances[state_first + k]
            alive = attenuate(
                processed,
                position,
                alive,
                x0,
                y0,
                state_first,
                records,
                lists,
                transmittances,
                fragments,
                view,
            )
            processed += 1

        processed_end = processed  # the fragments of the last segment are stored
        while processed > start:
            segment = (processed - 1 - start) / SEGMENT
            first = start + segment * SEGMENT
            if processed < processed_end:
                for k in range(area):
                    transmittances[state_first + k] = checkpoints[own + segment * area + k]
                for position in range(SEGMENT):
                    attenuate(
                        first + position,
                        position,
                        0,
                        x0,
                        y0,
                        state_first,
                        records,
                        lists,
                        transmittances,
                        fragments,
                        view,
                    )
            while processed > first:
                processed -= 1
                s = read(records, lists, processed, view)
                touched = clipped_box(records, lists[processed], x0, y0, view)
                total = GradientSums()
                for row in range(touched[2], touched[3]):
                    for column in range(touched[0], touched[1]):
                        at = state_first + row * view.tile_w + column
                        fragment = fragments[at * SEGMENT + processed - first]
                        if fragment[1] > 0.0:
                            values, pixel_gradient = fragment_gradient(
                                s, lists[processed], x0 + column, y0 + row, fragment[0], fragment[1],
                                pixel_gradients[at], log_ceiling, records, view,
                            )  # fmt: skip
                            pixel_gradients[at] = pixel_gradient
                            total += values
                gradient_sums[gradient_offsets[processed]] = total

    return SimpleNamespace(
        kernel=blend_backward_gpu if on_gpu else blend_backward_cpu,
        ImageGradients=ImageGradients,
        PixelGradient=PixelGradient,
        GradientSums=GradientSums,
    )
