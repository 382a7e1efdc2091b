// Termination depth of each tile for occlusion culling (fidsplat/backends/termination_depth.py), in centre order: the sort key at
// which all its pixels were terminated, or UINT_MAX if the list ended first. Splats behind it cannot change the tile.
//@ lanes_start
    uint last_read = UINT_MAX;     // last position in `lists` that was processed
//@ tile_loop_segment
        last_read = segment + length - 1;
//@ pass_end
    termination_depths[tile] = !alive && last_read != UINT_MAX
//@@ termination_known
        ? keys[lists[last_read]] : UINT_MAX;
