// Lists of many views of few tiles each, for GPUs: a work-group takes many splats of one view, counts their pairs by tile in local
// memory, and asks for the places of all pairs of a tile at once. tiles.cl, whose kernels do the rest, asks pair by pair.

#define GATHERED 4096             // splats of a work-group
#define GATHER_TILES 4096         // of a view, at most

// The work-group's share of the splats of its view [first, end), as places among those of all views.
typedef struct { uint first, end; } Share;

static inline Share share_of(uint count) {
    uint before = get_group_id(1) * count, first = get_group_id(0) * GATHERED;
    Share share = {before + first, before + min(first + GATHERED, count)};
    return share;
}

// Numbers of pairs of the share by tile. listed: a word for each tile of the view.
static inline void gather(const Share *share, int tiles, int tiles_x, global const uint2 *restrict windows,
                          global const uint *restrict keys, local uint *listed) {
    for (int tile = get_local_id(0); tile < tiles; tile += SCAN_ITEMS) listed[tile] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint splat = share->first + get_local_id(0); splat < share->end; splat += SCAN_ITEMS) {
        if (keys[splat] == CULLED) continue;
        for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) atomic_inc(listed + window_tile(window, tiles_x));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Index space: for each view a work-group for every GATHERED splats.
// Reads: windows, keys. Writes: adds to tallies.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void tally_gathered(
//@@ arguments tally_gathered
) {
    local uint listed[GATHER_TILES];
    const Share share = share_of(count);
    int tiles = tiles_of(width, height);
    gather(&share, tiles, (width + TILE_W - 1) / TILE_W, windows, keys, listed);
    tallies += TALLIES + get_group_id(1) * (uint)tiles;
    for (int tile = get_local_id(0); tile < tiles; tile += SCAN_ITEMS)
        if (listed[tile] != 0) atomic_add(tallies + tile, listed[tile]);
}

// Index space: as tally_gathered.
// Reads: windows, keys, starts. Uses up: cursors of the band. Writes: pairs; adds to counts' number of visible splats.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void emit_gathered(
//@@ arguments emit_gathered
) {
    local uint listed[GATHER_TILES];
    local uint visible;
    const Share share = share_of(count);
    int tiles = tiles_of(width, height), tiles_x = (width + TILE_W - 1) / TILE_W, before = (int)get_group_id(1) * tiles;
    const Band band = {tiles_x, band_first, band_end, starts[band_first], capacity};
    if (get_local_id(0) == 0) visible = 0;
    gather(&share, tiles, tiles_x, windows, keys, listed);
    for (int tile = get_local_id(0); tile < tiles; tile += SCAN_ITEMS)
        if (listed[tile] != 0 && before + tile >= band.first && before + tile < band.end)
            listed[tile] = atomic_add(cursors + before + tile, listed[tile]);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint splat = share.first + get_local_id(0); splat < share.end; splat += SCAN_ITEMS) {
        uint key = keys[splat];
        if (key == CULLED) continue;
        if (first_band) atomic_inc(&visible);
        for (uint2 window = windows[splat]; window.y != 0; window.y &= window.y - 1) {
            int tile = window_tile(window, tiles_x);
            if (before + tile < band.first || before + tile >= band.end) continue;
            // modulo 2^32, as place_of
            uint place = atomic_inc(listed + tile) - band.start;
            if (place < band.capacity) pairs[place] = (uint2)(splat, key);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0 && visible != 0) atomic_add(counts + COUNT_VISIBLE, visible);
}
