// Lists of splats per tile, each in depth order: a counting sort whose bins are the tiles.
// Index space of both kernels: one work-item per chunk of the depth-sorted splats.

// Reads: order, counts[slot] (visible splats), bounds. Writes: this chunk's row of table[CHUNKS][tiles].
kernel void bin_count(global const uint *restrict order, global const uint *restrict counts, uint slot,
                      global const Bounds *restrict all_bounds, int width, int height, global uint *restrict table) {
    uint chunk = get_global_id(0);
    if (chunk >= CHUNKS) return;
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    global uint *row = table + (size_t)chunk * tiles_x * tiles_y;
    for (int tile = 0; tile < tiles_x * tiles_y; tile++) row[tile] = 0;
    uint length = counts[slot], each = (length + CHUNKS - 1) / CHUNKS;
    uint from = min(chunk * each, length), to = min(from + each, length);
    for (uint k = from; k < to; k++) {
        Bounds b = all_bounds[order[k]];
        int y0, y1;
        bounds_rows(&b, height, &y0, &y1);
        for (int ty = y0 / TILE_H; ty * TILE_H < y1; ty++) {
            TileSpan span = tile_span(&b, ty, width, height);
            for (int tx = span.first; tx <= span.last; tx++) row[ty * tiles_x + tx]++;
        }
    }
}

// Reads: order, counts[slot], bounds, starts. Uses up: table, of the tiles in the band.
// Writes: lists of the tiles of the band [band_first, band_end), from 0; never beyond `capacity`.
kernel void bin_emit(global const uint *restrict order, global const uint *restrict counts, uint slot,
                     global const Bounds *restrict all_bounds, int width, int height, global uint *restrict table,
                     global const uint *restrict starts, int band_first, int band_end, uint capacity,
                     global uint *restrict lists) {
    uint chunk = get_global_id(0);
    if (chunk >= CHUNKS) return;
    int tiles_x = (width + TILE_W - 1) / TILE_W, tiles_y = (height + TILE_H - 1) / TILE_H;
    global uint *row = table + (size_t)chunk * tiles_x * tiles_y;
    uint length = counts[slot], each = (length + CHUNKS - 1) / CHUNKS;
    uint from = min(chunk * each, length), to = min(from + each, length);
    for (uint k = from; k < to; k++) {
        uint index = order[k];
        Bounds b = all_bounds[index];
        int y0, y1;
        bounds_rows(&b, height, &y0, &y1);
        for (int ty = max(y0 / TILE_H, band_first / tiles_x); ty * TILE_H < y1 && ty * tiles_x < band_end; ty++) {
            TileSpan span = tile_span(&b, ty, width, height);
            for (int tx = span.first; tx <= span.last; tx++) {
                int tile = ty * tiles_x + tx;
                if (tile < band_first || tile >= band_end) continue;
                // modulo 2^32: a place within the band is right even where the picture has more pairs than that
                uint place = starts[tile] - starts[band_first] + row[tile]++;
                if (place < capacity) lists[place] = index;
            }
        }
    }
}
