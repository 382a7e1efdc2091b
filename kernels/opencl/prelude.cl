// Build constants that `assemble` prints above this file, and the numeric types made from them.
//   LANES          pixels that one work-item computes side by side (1 on a GPU, 8 or 16 on a CPU)
//   TILE_W TILE_H  pixels of a tile; the lanes schedule needs TILE_W == LANES
//   CHUNKS         contiguous pieces into which lists are cut where order must be kept without atomics
//   RADIX_BITS     digit width of the depth sort
//   SCAN_ITEMS     work-items of the one work-group that scans
//   SETUP_FP64     1: per-splat set-up in double
//   SAMPLES        n of the n x n samples per pixel

// Contraction is chosen by hand (FMA below), never by the compiler: the same pixel must get the same bits in every
// schedule, tile size and set of outputs, and order and culling must not depend on the device (numerics F1).
#pragma OPENCL FP_CONTRACT OFF

#if SETUP_FP64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
#define REAL(x) x
#else
typedef float real;
#define REAL(x) x##f
#endif

#define CULLED 0xFFFFFFFFu   // sort key of a splat that is not drawn
#define OUT_OF_BAND 0xFFFFFFFEu  // of one that is drawn in another band of rows only

// places in the buffer `tallies`: numbers of visible splats, of pairs (64 bits each) and of big splats; then one word per tile,
// or the same of the next view
enum { TALLY_VISIBLE = 0, TALLY_PAIRS = 2, TALLY_BIG = 6, TALLIES = 8 };
