"""Staging of splats in a GPU block's shared memory: records, and for each cell of the tile a list of the
splats that may overlap it (cells.py).

Warp's tiles have no 16-byte reads, shuffles or bytes in shared memory, so these functions are in CUDA.
On the CPU a block is one thread: records are read from global memory, and the list of a cell is the complete
range of staged splats.
"""

from types import SimpleNamespace

import warp as wp

from .common import with_numbers
from .records import RecordLayout

STAGED = 128
"""maximum number of splats that are staged at once"""


_SHARED_MEMORY = """
#if defined(__CUDA_ARCH__)
    // records; 16 bytes for each cell, a bit for each splat that can touch it; its list, a byte for each
    __shared__ float4 staged[SPLATS * VEC4S + CELLS + (CELLS * STRIDE + 15) / 16];
    return static_cast<wp::uint64>(__cvta_generic_to_shared(staged));
#else
    return 0;
#endif
"""
_STAGE = """
#if defined(__CUDA_ARCH__)
    // all that was staged before is read by then
    if (!__syncthreads_or(open)) return false;
    float4* staged = reinterpret_cast<float4*>(__cvta_shared_to_generic(shared_memory));
    const float4* from = reinterpret_cast<const float4*>(records.data);
    // in the order of memory, so that neighbours in the block read neighbours in memory
    for (int k = threadIdx.x; k < length * VEC4S; k += blockDim.x)
        staged[k] = __ldg(from + static_cast<size_t>(lists.data[first + k / VEC4S]) * VEC4S + k % VEC4S);
    __syncthreads();
    return true;
#else
    return open;
#endif
"""
_MARK_CELLS = """
#if defined(__CUDA_ARCH__)
    float4* staged = reinterpret_cast<float4*>(__cvta_shared_to_generic(shared_memory));
    unsigned int* touched = reinterpret_cast<unsigned int*>(staged + SPLATS * VEC4S);
    const unsigned int lane = threadIdx.x & 31;
    // 32 splats by 32 cells, turned: in each step squares of bits change places across the diagonal
    unsigned int bits = cells;
#pragma unroll
    for (unsigned int side = 16, low = 0xffffu; side != 0; side /= 2, low ^= low << side) {
        const unsigned int other = __shfl_xor_sync(0xffffffffu, bits, side);
        bits = lane & side ? (bits & ~low) | (other >> side & low) : (bits & low) | (other << side & ~low);
    }
    const unsigned int cell = 32 * group + lane;
    if (cell < CELLS) touched[4 * cell + word] = bits;
#endif
"""
_LIST_CELL = """
#if defined(__CUDA_ARCH__)
    // all are marked by then
    __syncthreads();
    const uint4* touched =
        reinterpret_cast<const uint4*>(__cvta_shared_to_generic(shared_memory)) + SPLATS * VEC4S;
    unsigned char* list = reinterpret_cast<unsigned char*>(__cvta_shared_to_generic(shared_memory))
                          + 16 * (SPLATS * VEC4S + CELLS) + cell * STRIDE;
    const uint4 bits = touched[cell];
    // words of splats staged earlier
    const unsigned int words[4] = {
        bits.x, length > 32 ? bits.y : 0, length > 64 ? bits.z : 0, length > 96 ? bits.w : 0
    };
    const unsigned int own = threadIdx.x % ITEMS;
    unsigned int mine = 0, before = 0, count = 0;
#pragma unroll
    for (unsigned int word = 0; word < 4; word++) {
        if (word == own) {
            mine = words[word];
            before = count;
        }
        count += __popc(words[word]);
    }
    for (; mine != 0; mine &= mine - 1)
        list[before++] = static_cast<unsigned char>(32 * own + __ffs(mine) - 1);
    // its threads are of one warp
    __syncwarp();
    return count;
#else
    return length;
#endif
"""
_CELL_SPLAT = """
#if defined(__CUDA_ARCH__)
    return (reinterpret_cast<const unsigned char*>(__cvta_shared_to_generic(shared_memory))
            + 16 * (SPLATS * VEC4S + CELLS))[cell * STRIDE + k];
#else
    return k;
#endif
"""
_STAGED_VEC4 = """
#if defined(__CUDA_ARCH__)
    const float4* staged = reinterpret_cast<const float4*>(__cvta_shared_to_generic(shared_memory));
    const float4 quad = staged[which * VEC4S + at];
    return wp::vec_t<4, wp::float32>(quad.x, quad.y, quad.z, quad.w);
#else
    return records.data[lists.data[first + which] * VEC4S + at];
#endif
"""
_IS_SINGLE_THREAD = """
#if defined(__CUDA_ARCH__)
    return false;
#else
    return true;
#endif
"""


@wp.func_native(_IS_SINGLE_THREAD)
def is_single_thread() -> bool:
    """Whether a block is a single thread, which processes all cells."""
    ...


def make_staging(layout: RecordLayout, cells: int, items: int) -> SimpleNamespace:
    """Make functions that stage records in shared memory: shared_memory; stage, mark_cells and
    list_cell, called after each staging; cell_splat and staged_vec4.

    layout: layout of the records. cells: cells per tile. items: threads of a warp per cell.
    """
    # padded, so that words of a list are in different banks
    numbers = {"SPLATS": STAGED, "VEC4S": layout.vec4s, "CELLS": cells, "ITEMS": items, "STRIDE": STAGED + 4}

    @wp.func_native(with_numbers(_SHARED_MEMORY, numbers))
    def shared_memory() -> wp.uint64:
        """Address of the block's shared memory."""
        ...

    @wp.func_native(with_numbers(_STAGE, numbers))
    def stage(
        shared_memory: wp.uint64,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        first: int,
        length: int,
        open: bool,
    ) -> bool:
        """Copy the records of lists[first : first + length], at most STAGED, to shared memory. A barrier.

        open: whether a pixel of this thread is unfinished. Returns false in all threads, without a copy, if
        all pixels of the block are finished.
        """
        ...

    @wp.func_native(with_numbers(_MARK_CELLS, numbers))
    def mark_cells(shared_memory: wp.uint64, word: int, group: int, cells: wp.uint32):
        """Store the cells 32 group to 32 group + 31 that a staged splat may overlap, as bits, for splats 32
        word to 32 word + 31, one per thread of a warp.
        """
        ...

    @wp.func_native(with_numbers(_LIST_CELL, numbers))
    def list_cell(shared_memory: wp.uint64, length: int, cell: int) -> int:
        """Number of staged splats that may overlap the thread's cell; call it after `mark_cells`."""
        ...

    @wp.func_native(with_numbers(_CELL_SPLAT, numbers))
    def cell_splat(shared_memory: wp.uint64, cell: int, k: int) -> int:
        """Index among the staged splats of the k-th splat in the list of a cell."""
        ...

    @wp.func_native(with_numbers(_STAGED_VEC4, numbers))
    def staged_vec4(
        shared_memory: wp.uint64,
        records: wp.array(dtype=wp.vec4),
        lists: wp.array(dtype=wp.int32),
        first: int,
        which: int,
        at: int,
    ) -> wp.vec4:
        """The 16 bytes `at` of the record of the staged splat `which`."""
        ...

    return SimpleNamespace(
        shared_memory=shared_memory,
        stage=stage,
        mark_cells=mark_cells,
        list_cell=list_cell,
        cell_splat=cell_splat,
        staged_vec4=staged_vec4,
    )
