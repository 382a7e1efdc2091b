// Resolve fused into blend, for one sample per pixel: saves a launch.
//@ tile_stored
    // resolved at once, while the samples are in the cache
    for (int y = y0; y < min(y0 + TILE_H, height); y++)
        for (int x = x0; x < min(x0 + TILE_W, width); x++) {
            const size_t first = (top + y) * stride + x;
//@@ resolve_pixel
        }
