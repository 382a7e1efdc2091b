// For GPUs: what work-items that go in step share of a tile. ITEMS neighbours in a group take a cell of CELL_W x CELL_H pixels, ROWS
// of a column each, and walk through those of the staged splats alone that can touch it.
#define GROUP (TILE_W * TILE_H / ROWS)
#define ITEMS 4                              // work-items of a cell
#define CELLS_X 8                            // cells side by side: as bits of a byte, four splats' bytes in a word
#define CELL_W (TILE_W / CELLS_X)
#define CELL_H (ITEMS / CELL_W * ROWS)
#define CELLS_Y (TILE_H / CELL_H)
#define BLOCK_X (CELLS_X / CELL_W)           // cells side by side of 8 that go in step, which are 8 pixels wide
#define STAGED 128
#define SHARE (STAGED / ITEMS)               // of the staged splats: 32
#define CELLS_STRIDE (STAGED + 4)             // bytes; the next row, of one row of cells or one cell, lies in other banks
#define CELLS_PAD 0.02f                      // of chords, in samples
enum { VECTORS = sizeof(Splat) / 16 };       // of 16 bytes, in a record

typedef union {              // what is staged of a splat, as vectors for fewer reads
    Splat splat;
    float4 words[VECTORS];
} Staged;

//@@ cells_functions

// Which cells of the tile at (left, top) the splat can touch: for each row of cells, of which it touches those from `first_row` to
// `last_row`, the cells as bits. Conservative; the test of each pixel decides.
static inline void touched_cells(local const Splat *s, int left, int top, wide half_r2, wide filter, local uchar *cells) {
    int first_row = max(s->y0 - top, 0) / CELL_H, last_row = (min(s->y1 - top, TILE_H) - 1) / CELL_H;
    float shift = (float)s->ax - (float)left;
//@@ cells_start
    for (int cell_row = 0; cell_row < CELLS_Y; cell_row++) cells[cell_row * CELLS_STRIDE] = 0;
    for (int cell_row = first_row; cell_row <= last_row; cell_row++) {
        // columns between which its rows of samples have fragments
        float y0 = (float)(top + cell_row * CELL_H) - (float)s->ay, y1 = y0 + (float)(CELL_H - 1), low = -INFINITY, high = INFINITY;
//@@ cells_row
//@@ cells_dot
        int first = max((int)clamp(ceil(low + shift), 0.0f, (float)TILE_W), s->x0 - left);
        int last = min((int)clamp(floor(high + shift), -1.0f, (float)(TILE_W - 1)), s->x1 - left - 1);
        if (first <= last) cells[cell_row * CELLS_STRIDE] = (uchar)((2u << (last / CELL_W)) - (1u << (first / CELL_W)));
    }
}

// The staged splats that can touch a cell, in order, as its ITEMS work-items find them, of which this is the `own`-th; the whole
// group comes here, where `cells` is made of all `length`. touched, places: of this cell. Returns how many there are.
static inline uint list_cell(local const uint *cells, uint cell_x, uint cell_y, uint own, uint length, local uint *touched,
                             local uchar *places) {
    uint bits = 0, listed = 0, before = 0;
    // a word's lowest byte is its first, as on every device
    for (uint k = 0; k < SHARE / 4; k++) {
        uint four = cells[cell_y * (CELLS_STRIDE / 4) + own * (SHARE / 4) + k] >> cell_x & 0x01010101u;
        bits |= (four * 0x01020408u >> 24 & 15u) << (4 * k);
    }
    uint first = own * SHARE, rest = max(length, first) - first;
    if (rest < SHARE) bits &= (1u << rest) - 1u;     // bytes that an earlier batch has left
    touched[own] = bits;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint other = 0; other < ITEMS; other++) {
        if (other == own) before = listed;
        listed += popcount(touched[other]);
    }
    for (; bits != 0; bits &= bits - 1) places[before++] = (uchar)(own * SHARE + 31 - clz(bits & -bits));
    barrier(CLK_LOCAL_MEM_FENCE);
    return listed;
}
