// Build constants, which `assemble` prints above this file (all: build_constants of fidsplat/backends/opencl/assemble.py), and the
// numeric types derived from them. Words of these files are explained in kernels/README.md.
// LANES          pixels that one work-item computes as a vector (1 on a GPU, 8 or 16 on a CPU)
// TILE_W TILE_H  pixels of a tile; the schedule `lanes` (CPUs: one work-item per tile) requires TILE_W == LANES
// SPLATS_PER_ITEM  splats that a work-item of `project` projects (1 on a GPU)
// SORT_BLOCKS    contiguous blocks into which the stable counting sorts divide a list
// RADIX_BITS     digit width of the depth sort
// SCAN_ITEMS     work-items of the single work-group of a scan
// PROJECTION_FP64  1: project splats in double
// SAMPLES        n of the n x n samples per pixel

// Contraction is written by hand (FMA in math.cl), never left to the compiler: a pixel must be bit-identical in every
// schedule, tile size and set of outputs, and order and culling must not depend on the device.
#pragma OPENCL FP_CONTRACT OFF

#if PROJECTION_FP64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
#define REAL(x) x
#else
typedef float real;
#define REAL(x) x##f
#endif

// Functions and loops that CPU compilers vectorise across a batch of splats.
#if SPLATS_PER_ITEM > 1
#define INLINE static inline __attribute__((always_inline))
#define VECTORISE _Pragma("clang loop vectorize(enable) vectorize_width(8) interleave_count(1)")
#define UNROLLED _Pragma("unroll")
#else
#define UNROLLED
#define INLINE static inline
#endif

#define CULLED 0xFFFFFFFFu   // sort key of a culled splat
#define OUT_OF_BAND 0xFFFFFFFEu  // sort key of a splat that is visible only in another band of rows

// Indices in the buffer `counters`: numbers of visible splats (of groups that are not culled, if groups are culled before projection),
// of splat-tile pairs (64 bits each), and of big splats, which overlap more tiles than a window (bounds.cl); then one
// count per tile, or the same counters of the next view.
enum { COUNTER_VISIBLE = 0, COUNTER_PAIRS = 2, COUNTER_BIG = 6, COUNTERS = 8 };
