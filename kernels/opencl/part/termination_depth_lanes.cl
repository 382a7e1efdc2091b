// For stores (fidsplat/backends/termination_depth.py), by centres: of each tile the sort key at which all of its pixels were finished; UINT_MAX
// where the list ended before. Whatever else the list may have behind that key, the tile has the same bits: it is not looked at.
//@ lanes_start
    uint last_read = UINT_MAX;     // the last place in `lists` that was looked at
//@ tile_loop_chunk
        last_read = chunk + length - 1;
//@ pass_end
    tile_ends[tile] = !alive && last_read != UINT_MAX ? keys[lists[last_read]] : UINT_MAX;
