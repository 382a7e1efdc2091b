"""Records of a batch of splats in a GPU block's shared memory, and which of them can touch a warp's samples.

Warp's own tiles have no 16-byte reads, votes or ballots, so these few functions are CUDA. On the CPU, where a
block is one thread, they read the records where they lie and let every splat through.
"""

import re
from types import SimpleNamespace

import warp as wp

from .records import Layout

STAGED = 256
"""splats of a batch, a multiple of 32; larger ones gain nothing"""
BLOCK_W, BLOCK_H = 8, 4
"""samples that the 32 threads of a warp draw, one each"""


_POOL = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 staged[SPLATS * LINES];
    return static_cast<wp::uint64>(__cvta_generic_to_shared(staged));
#else
    return 0;
#endif
"""
_STAGE = """
#if defined(__CUDA_ARCH__)
    // all that was staged before is read by then
    if (!__syncthreads_or(open)) return false;
    float4* staged = reinterpret_cast<float4*>(__cvta_shared_to_generic(pool));
    const float4* from = reinterpret_cast<const float4*>(lines.data);
    // line by line, so that neighbours in the block read neighbours in memory
    for (int k = threadIdx.x; k < length * LINES; k += blockDim.x)
        staged[k] = __ldg(from + static_cast<size_t>(lists.data[first + k / LINES]) * LINES + k % LINES);
    __syncthreads();
    return true;
#else
    return open;
#endif
"""
_TOUCHED = """
#if defined(__CUDA_ARCH__)
    if (!__any_sync(0xffffffffu, open)) return 0;
    const float4* staged = reinterpret_cast<const float4*>(__cvta_shared_to_generic(pool));
    const int which = 32 * word + (threadIdx.x & 31);
    bool hit = false;
    if (which < length) {
        const float* record = reinterpret_cast<const float*>(staged + which * LINES);
        const uint2 box = *reinterpret_cast<const uint2*>(record + BOX);
        hit = static_cast<int>(box.x & 0xffffu) < left + BLOCK_W && static_cast<int>(box.x >> 16) > left
           && static_cast<int>(box.y & 0xffffu) < top + BLOCK_H && static_cast<int>(box.y >> 16) > top;
    }
    return __ballot_sync(0xffffffffu, hit);
#else
    const int rest = length - 32 * word;
    return rest >= 32 ? 0xffffffffu : (1u << rest) - 1u;
#endif
"""
_LINE = """
#if defined(__CUDA_ARCH__)
    const float4* staged = reinterpret_cast<const float4*>(__cvta_shared_to_generic(pool));
    const float4 quad = staged[which * LINES + line];
    return wp::vec_t<4, wp::float32>(quad.x, quad.y, quad.z, quad.w);
#else
    return lines.data[lists.data[first + which] * LINES + line];
#endif
"""


def with_numbers(text: str, numbers: dict[str, int]) -> str:
    """The text with these names as their numbers."""
    return re.sub("|".join(numbers), lambda name: str(numbers[name[0]]), text)


def make_staging(layout: Layout) -> SimpleNamespace:
    """pool; then, for each batch, stage, touched, line. For records of this layout."""
    numbers = {"SPLATS": STAGED, "LINES": layout.lines, "BOX": layout.names.index("columns")}
    numbers |= {"BLOCK_W": BLOCK_W, "BLOCK_H": BLOCK_H}

    @wp.func_native(with_numbers(_POOL, numbers))
    def pool() -> wp.uint64:
        """Where the block's records lie in shared memory."""
        ...

    @wp.func_native(with_numbers(_STAGE, numbers))
    def stage(
        pool: wp.uint64,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        first: int,
        length: int,
        open: bool,
    ) -> bool:
        """Brings the records of lists[first : first + length], at most STAGED; false, for the whole block, if
        nobody in it is open.
        """
        ...

    @wp.func_native(with_numbers(_TOUCHED, numbers))
    def touched(pool: wp.uint64, word: int, length: int, left: int, top: int, open: bool) -> wp.uint32:
        """Bits of those of the staged splats 32 word to 32 word + 31 that can touch the warp's samples, whose
        first is (left, top); none if nobody in the warp is open.
        """
        ...

    @wp.func_native(with_numbers(_LINE, numbers))
    def line(
        pool: wp.uint64,
        lines: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        first: int,
        which: int,
        line: int,
    ) -> wp.vec4:
        """A line of the record of the staged splat `which`."""
        ...

    return SimpleNamespace(pool=pool, stage=stage, touched=touched, line=line)
