// Tile binning on GPUs with counts in local memory, for many views of few tiles and for stores, whose neighbouring splats share
// tiles. A work-group counts the pairs of many splats per tile, then reserves all list entries of a tile by one atomic. The
// kernels of tile_lists.cl, which complete the lists, take one global atomic per pair, and atomics on one tile are serialised.

#define WORK_GROUP_SPLATS 4096             // splats of a work-group
#define LOCAL_TILES 4096         // tiles with a count in local memory

// Splats of the work-group [first, end), as indices among those of all views.
typedef struct { uint first, end; } SplatRange;

static inline SplatRange splat_range_of(uint count) {
    uint before = get_group_id(1) * count, first = get_group_id(0) * WORK_GROUP_SPLATS;
    SplatRange range = {before + first, before + min(first + WORK_GROUP_SPLATS, count)};
    return range;
}

// Tiles that are counted: all tiles of a small view, else a rectangle around the windows of the work-group's splats. corner: as in
// a window.
typedef struct { uint corner; int columns, tiles; } Area;

// extents: scratch of four values.
static inline Area area_of(const SplatRange *range, int tiles, int tiles_x, global const uint2 *restrict windows,
                           global const uint *restrict keys, local int *extents) {
    Area area = {0, tiles_x, tiles};
    if (tiles <= LOCAL_TILES) return area;
    if (get_local_id(0) < 4) extents[get_local_id(0)] = 0xFFFF;
    barrier(CLK_LOCAL_MEM_FENCE);
    int4 extent = 0xFFFF;          // minima of left, top, -left, -top of the windows' corners
    for (uint splat = range->first + get_local_id(0); splat < range->end; splat += SCAN_ITEMS) {
        if (keys[splat] == CULLED || windows[splat].y == 0) continue;
        int left = windows[splat].x & 0xFFFFu, top = windows[splat].x >> 16;
        extent = min(extent, (int4)(left, top, -left, -top));
    }
    atomic_min(extents, extent.x);
    atomic_min(extents + 1, extent.y);
    atomic_min(extents + 2, extent.z);
    atomic_min(extents + 3, extent.w);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (extents[2] == 0xFFFF) return area;   // no splat has a window
    area.corner = (uint)extents[0] | (uint)extents[1] << 16;
    area.columns = WINDOW_W - extents[2] - extents[0];
    area.tiles = area.columns * (WINDOW_H - extents[3] - extents[1]);
    return area;
}

// Index of a window's tile in the area, and the inverse: the tile of an index.
static inline int area_index(const Area *area, uint2 window) {
    return window_tile((uint2)(window.x - area->corner, window.y), area->columns);
}
static inline int area_tile(const Area *area, int position, int tiles_x) {
    return ((int)(area->corner >> 16) + position / area->columns) * tiles_x + (int)(area->corner & 0xFFFFu) + position % area->columns;
}

// Number of pairs of each tile of the area. pair_counts: one word per tile.
static inline void count_pairs(const SplatRange *range, const Area *area, global const uint2 *restrict windows, global const uint *restrict keys,
                          local uint *pair_counts) {
    for (int position = get_local_id(0); position < area->tiles; position += SCAN_ITEMS) pair_counts[position] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint splat = range->first + get_local_id(0); splat < range->end; splat += SCAN_ITEMS) {
        if (keys[splat] == CULLED) continue;
        for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) atomic_inc(pair_counts + area_index(area, window));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Index space: for each view a work-group for every WORK_GROUP_SPLATS splats.
// Reads: windows, keys. Adds to: counters.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void count_local(
//@@ arguments count_local
) {
    local uint pair_counts[LOCAL_TILES];
    local int extents[4];
    const SplatRange range = splat_range_of(count);
    int tiles = tiles_of(width, height), tiles_x = (width + TILE_W - 1) / TILE_W;
    counters += COUNTERS + get_group_id(1) * (uint)tiles;
    const Area area = area_of(&range, tiles, tiles_x, windows, keys, extents);
    if (area.tiles > LOCAL_TILES) {      // too many tiles for local memory
        for (uint splat = range.first + get_local_id(0); splat < range.end; splat += SCAN_ITEMS) {
            if (keys[splat] == CULLED) continue;
            for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) atomic_inc(counters + window_tile(window, tiles_x));
        }
        return;
    }
    count_pairs(&range, &area, windows, keys, pair_counts);
    for (int position = get_local_id(0); position < area.tiles; position += SCAN_ITEMS)
        if (pair_counts[position] != 0) atomic_add(counters + area_tile(&area, position, tiles_x), pair_counts[position]);
}

// Index space: as count_local.
// Reads: windows, keys, starts. Reads and overwrites: cursors of the range. Writes: pairs; adds to frame_counts[COUNT_VISIBLE].
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void emit_local(
//@@ arguments emit_local
) {
    local uint pair_counts[LOCAL_TILES];
    local uint visible;
    local int extents[4];
    const SplatRange range = splat_range_of(count);
    int tiles = tiles_of(width, height), tiles_x = (width + TILE_W - 1) / TILE_W, before = (int)get_group_id(1) * tiles;
    const TileRange tile_range = {tiles_x, first_tile, end_tile, starts[first_tile], capacity};
    if (get_local_id(0) == 0) visible = 0;
    const Area area = area_of(&range, tiles, tiles_x, windows, keys, extents);
    bool counted = area.tiles <= LOCAL_TILES;
    if (counted) {
        count_pairs(&range, &area, windows, keys, pair_counts);
        for (int position = get_local_id(0); position < area.tiles; position += SCAN_ITEMS) {
            if (pair_counts[position] == 0) continue;
            int tile = before + area_tile(&area, position, tiles_x);
            if (tile >= tile_range.first && tile < tile_range.end) pair_counts[position] = atomic_add(cursors + tile, pair_counts[position]);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    uint visible_here = 0;
    for (uint splat = range.first + get_local_id(0); splat < range.end; splat += SCAN_ITEMS) {
        uint key = keys[splat];
        if (key == CULLED) continue;
        if (counts_visible) visible_here++;
        for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) {
            int tile = before + window_tile(window, tiles_x);
            if (tile < tile_range.first || tile >= tile_range.end) continue;
            // modulo 2^32, see next_offset
            uint position = counted ? atomic_inc(pair_counts + area_index(&area, window)) - tile_range.start : next_offset(tile, &tile_range, cursors, false);
            if (position < tile_range.capacity) pairs[position] = (uint2)(splat, key);
        }
    }
    if (visible_here != 0) atomic_add(&visible, visible_here);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0 && visible != 0) atomic_add(frame_counts + COUNT_VISIBLE, visible);
}
