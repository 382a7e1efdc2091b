// As part/termination_depth_lanes.cl, for GPUs: lists are looked at in whole batches. The last does not count, since no vote follows it.
//@ group_start
    if (item == 0) tile_ends[tile] = UINT_MAX;
//@ voted
        if (!alive && item == 0 && batch > start) tile_ends[tile] = keys[lists[batch - 1]];
