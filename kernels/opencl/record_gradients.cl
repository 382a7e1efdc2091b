// Gradients of a splat's record, summed over the pixels of one tile (`RecordGradient`), and the number of tiles of a splat.

//@@ struct RecordGradient
#define FIELDS (sizeof(RecordGradient) / sizeof(float))

// Number of tiles of a splat.
static inline uint tile_count(uint2 window, uint big_capacity, global const Bounds *big_bounds, int width, int height) {
    if (window.y != 0) return popcount(window.y);
    if (window.x >= big_capacity) return 0;
    const Bounds b = big_bounds[window.x];
    int y0, y1;
    bounds_rows(&b, height, &y0, &y1);
    uint tiles = 0;
    for (int row = y0 / TILE_H; row * TILE_H < y1; row++) {
        TileSpan span = tile_span(&b, row, width, height);
        tiles += max(span.last - span.first + 1, 0);
    }
    return tiles;
}
