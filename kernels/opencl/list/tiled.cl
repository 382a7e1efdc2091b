// Counts tiles during projection (GPUs): adds each tile of the splat's window to the counters (tile_lists.cl). Integer sums do
// not depend on the order of the additions.
//@ list
    int tiles_x = (width + TILE_W - 1) / TILE_W;
    counters += view_index * (uint)(tiles_x * ((height + TILE_H - 1) / TILE_H));
    bool shared = window != 0 && SHARES(window_tile((uint2)(corner, window), tiles_x));
    for (uint mask = window; mask != 0; mask &= mask - 1)
        INCREMENT(counters + COUNTERS, window_tile((uint2)(corner, mask), tiles_x), shared);
