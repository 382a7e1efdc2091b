// Culling of staged splats by cells of a tile, for GPUs. ITEMS neighbouring work-items share a cell of CELL_W x CELL_H pixels, ROWS of
// a column each, and loop over the staged splats that overlap it.
#define GROUP (TILE_W * TILE_H / ROWS)
#define ITEMS 4                              // work-items per cell
#define CELLS_X 8                            // cells in a row: a byte of each splat has one bit per cell; four bytes in a word
#define CELL_W (TILE_W / CELLS_X)
#define CELL_H (ITEMS / CELL_W * ROWS)
#define CELLS_Y (TILE_H / CELL_H)
#define BLOCK_X (CELLS_X / CELL_W)           // cells in a row of a warp's block: 8 cells, together 8 pixels wide
#define STAGED 128
#define SHARE (STAGED / ITEMS)               // staged splats per work-item of a cell: 32
#define CELLS_STRIDE (STAGED + 4)             // bytes; padded against bank conflicts
#define CELLS_PAD 0.02f                      // padding of chords, in samples
enum { VECTORS = sizeof(Splat) / 16 };       // vectors of 16 bytes per record

typedef union {              // a staged record, as vectors for fewer reads
    Splat splat;
    float4 words[VECTORS];
} Staged;

//@@ cells_functions

// Bits of a splat's cells: with the vendor's shuffles, and 32 cells, a word for each splat, which a warp transposes to a word for each
// cell; else a byte for each row of cells.
#if defined(TRANSPOSE_BITS) && CELLS_X * (TILE_H / CELL_H) == 32
#define CELLS_BY_WARP
#define CELL_BITS uint
#define SET_CELLS(cells, row, bits) (*(cells) |= (bits) << (CELLS_X * (row)))
#else
#define CELL_BITS local uchar
#define SET_CELLS(cells, row, bits) ((cells)[(row) * CELLS_STRIDE] = (uchar)(bits))
#endif

// Cells of the tile at (left, top) that the splat overlaps, from `first_row` to `last_row`. Conservative; the test of each pixel
// decides.
static inline void touched_cells(local const Splat *s, int left, int top, blend_real half_r2, blend_real sample_area, CELL_BITS *cells
//@@ cells_parameters
) {
    int first_row = max(s->y0 - top, 0) / CELL_H, last_row = (min(s->y1 - top, TILE_H) - 1) / CELL_H;
    float shift = (float)s->ax - (float)left;
//@@ cells_start
    for (int cell_row = 0; cell_row < CELLS_Y; cell_row++) SET_CELLS(cells, cell_row, 0u);
//@@ cells_occluded
    for (int cell_row = first_row; cell_row <= last_row; cell_row++) {
        // columns with fragments in the cell's rows of samples
        float y0 = (float)(top + cell_row * CELL_H) - (float)s->ay, y1 = y0 + (float)(CELL_H - 1), low = -INFINITY, high = INFINITY;
//@@ cells_row
//@@ cells_lowpass
        int first = max((int)clamp(ceil(low + shift), 0.0f, (float)TILE_W), s->x0 - left);
        int last = min((int)clamp(floor(high + shift), -1.0f, (float)(TILE_W - 1)), s->x1 - left - 1);
        if (first <= last) SET_CELLS(cells, cell_row, (2u << (last / CELL_W)) - (1u << (first / CELL_W)));
    }
}

// Finds the cells of all `length` staged splats. Called by the complete work-group, before a barrier and list_cell.
static inline void find_cells(local const Staged *staged, uint length, int left, int top, const BlendConstants *constants,
                              local uint *cells, local uint (*touched)[ITEMS]
//@@ cells_parameters
) {
#ifdef CELLS_BY_WARP
    uint lane = get_local_id(0) % 32;
    for (uint share = get_local_id(0) / 32; share < ITEMS; share += GROUP / 32) {
        uint which = share * SHARE + lane, bits = 0;
        local const Splat *s = &staged[which].splat;
        if (which < length) {
            touched_cells(s, left, top, s->log_opacity - constants->log_alpha_cutoff, constants->sample_area, &bits
//@@ cells_arguments
            );
        }
        touched[lane][share] = TRANSPOSE_BITS(bits);
    }
#else
    for (uint which = get_local_id(0); which < length; which += GROUP) {
        local const Splat *s = &staged[which].splat;
        touched_cells(s, left, top, s->log_opacity - constants->log_alpha_cutoff, constants->sample_area, (local uchar *)cells + which
//@@ cells_arguments
        );
    }
#endif
}

// Lists the staged splats that overlap a cell, in order. Called by the complete work-group; `cell_item` is the index of the work-item in its
// cell. touched, cell_splats: of this cell. Returns the number of splats.
static inline uint list_cell(local const uint *cells, uint cell_x, uint cell_y, uint cell_item, uint length, local uint *touched,
                             local uchar *cell_splats) {
    uint listed = 0, before = 0;
#ifdef CELLS_BY_WARP
    uint bits = touched[cell_item];
#else
    uint bits = 0;
    // the lowest byte of a word is its first on all devices
    for (uint k = 0; k < SHARE / 4; k++) {
        uint four = cells[cell_y * (CELLS_STRIDE / 4) + cell_item * (SHARE / 4) + k] >> cell_x & 0x01010101u;
        bits |= (four * 0x01020408u >> 24 & 15u) << (4 * k);
    }
    uint first = cell_item * SHARE, rest = max(length, first) - first;
    if (rest < SHARE) bits &= (1u << rest) - 1u;     // stale bytes of splats staged earlier
    touched[cell_item] = bits;
    barrier(CLK_LOCAL_MEM_FENCE);
#endif
    for (uint other = 0; other < ITEMS; other++) {
        if (other == cell_item) before = listed;
        listed += popcount(touched[other]);
    }
    for (; bits != 0; bits &= bits - 1) cell_splats[before++] = (uchar)(cell_item * SHARE + 31 - clz(bits & -bits));
#ifdef CELLS_BY_WARP
    WARP_BARRIER();
#else
    barrier(CLK_LOCAL_MEM_FENCE);
#endif
    return listed;
}
