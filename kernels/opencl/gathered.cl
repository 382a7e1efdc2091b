// Lists for GPUs where a work-group's splats share tiles: of many views of few tiles each, and of stores, whose neighbours lie near
// each other. A work-group takes many splats of one view, counts their pairs by tile in local memory, and asks for the places of all
// pairs of a tile at once. tiles.cl, whose kernels do the rest, asks pair by pair, and who asks for one tile waits for each other.

#define GATHERED 4096             // splats of a work-group
#define GATHER_TILES 4096         // that are counted in local memory

// The work-group's share of the splats of its view [first, end), as places among those of all views.
typedef struct { uint first, end; } Share;

static inline Share share_of(uint count) {
    uint before = get_group_id(1) * count, first = get_group_id(0) * GATHERED;
    Share share = {before + first, before + min(first + GATHERED, count)};
    return share;
}

// The tiles whose pairs are counted: all of a small view, else a rectangle around the share's windows. corner: as a window's.
typedef struct { uint corner; int columns, tiles; } Area;

// ends: four values for its own use.
static inline Area area_of(const Share *share, int tiles, int tiles_x, global const uint2 *restrict windows,
                           global const uint *restrict keys, local int *ends) {
    Area area = {0, tiles_x, tiles};
    if (tiles <= GATHER_TILES) return area;
    if (get_local_id(0) < 4) ends[get_local_id(0)] = 0xFFFF;
    barrier(CLK_LOCAL_MEM_FENCE);
    int4 least = 0xFFFF;          // left, top, and right and bottom from the other side
    for (uint splat = share->first + get_local_id(0); splat < share->end; splat += SCAN_ITEMS) {
        if (keys[splat] == CULLED || windows[splat].y == 0) continue;
        int left = windows[splat].x & 0xFFFFu, top = windows[splat].x >> 16;
        least = min(least, (int4)(left, top, -left, -top));
    }
    atomic_min(ends, least.x);
    atomic_min(ends + 1, least.y);
    atomic_min(ends + 2, least.z);
    atomic_min(ends + 3, least.w);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (ends[2] == 0xFFFF) return area;   // none: nothing is counted in it
    area.corner = (uint)ends[0] | (uint)ends[1] << 16;
    area.columns = WINDOW_W - ends[2] - ends[0];
    area.tiles = area.columns * (WINDOW_H - ends[3] - ends[1]);
    return area;
}

// A window's place in an area, and the tile of the view that has a place.
static inline int place_in(const Area *area, uint2 window) { return window_tile((uint2)(window.x - area->corner, window.y), area->columns); }
static inline int tile_at(const Area *area, int place, int tiles_x) {
    return ((int)(area->corner >> 16) + place / area->columns) * tiles_x + (int)(area->corner & 0xFFFFu) + place % area->columns;
}

// Numbers of pairs of the share by place in the area. listed: a word for each.
static inline void gather(const Share *share, const Area *area, global const uint2 *restrict windows, global const uint *restrict keys,
                          local uint *listed) {
    for (int place = get_local_id(0); place < area->tiles; place += SCAN_ITEMS) listed[place] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint splat = share->first + get_local_id(0); splat < share->end; splat += SCAN_ITEMS) {
        if (keys[splat] == CULLED) continue;
        for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) atomic_inc(listed + place_in(area, window));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Index space: for each view a work-group for every GATHERED splats.
// Reads: windows, keys. Writes: adds to tallies.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void tally_gathered(
//@@ arguments tally_gathered
) {
    local uint listed[GATHER_TILES];
    local int ends[4];
    const Share share = share_of(count);
    int tiles = tiles_of(width, height), tiles_x = (width + TILE_W - 1) / TILE_W;
    tallies += TALLIES + get_group_id(1) * (uint)tiles;
    const Area area = area_of(&share, tiles, tiles_x, windows, keys, ends);
    if (area.tiles > GATHER_TILES) {      // too far apart
        for (uint splat = share.first + get_local_id(0); splat < share.end; splat += SCAN_ITEMS) {
            if (keys[splat] == CULLED) continue;
            for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) atomic_inc(tallies + window_tile(window, tiles_x));
        }
        return;
    }
    gather(&share, &area, windows, keys, listed);
    for (int place = get_local_id(0); place < area.tiles; place += SCAN_ITEMS)
        if (listed[place] != 0) atomic_add(tallies + tile_at(&area, place, tiles_x), listed[place]);
}

// Index space: as tally_gathered.
// Reads: windows, keys, starts. Uses up: cursors of the band. Writes: pairs; adds to counts' number of visible splats.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void emit_gathered(
//@@ arguments emit_gathered
) {
    local uint listed[GATHER_TILES];
    local uint visible;
    local int ends[4];
    const Share share = share_of(count);
    int tiles = tiles_of(width, height), tiles_x = (width + TILE_W - 1) / TILE_W, before = (int)get_group_id(1) * tiles;
    const Band band = {tiles_x, band_first, band_end, starts[band_first], capacity};
    if (get_local_id(0) == 0) visible = 0;
    const Area area = area_of(&share, tiles, tiles_x, windows, keys, ends);
    bool counted = area.tiles <= GATHER_TILES;
    if (counted) {
        gather(&share, &area, windows, keys, listed);
        for (int place = get_local_id(0); place < area.tiles; place += SCAN_ITEMS) {
            if (listed[place] == 0) continue;
            int tile = before + tile_at(&area, place, tiles_x);
            if (tile >= band.first && tile < band.end) listed[place] = atomic_add(cursors + tile, listed[place]);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    uint seen = 0;
    for (uint splat = share.first + get_local_id(0); splat < share.end; splat += SCAN_ITEMS) {
        uint key = keys[splat];
        if (key == CULLED) continue;
        if (first_band) seen++;
        for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) {
            int tile = before + window_tile(window, tiles_x);
            if (tile < band.first || tile >= band.end) continue;
            // modulo 2^32, as place_of
            uint place = counted ? atomic_inc(listed + place_in(&area, window)) - band.start : place_of(tile, &band, cursors);
            if (place < band.capacity) pairs[place] = (uint2)(splat, key);
        }
    }
    if (seen != 0) atomic_add(&visible, seen);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0 && visible != 0) atomic_add(counts + COUNT_VISIBLE, visible);
}
