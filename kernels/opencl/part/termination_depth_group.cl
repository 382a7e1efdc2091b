// Termination depths of tiles for GPUs (part/termination_depth_lanes.cl), per batch of splats. There is no vote after the last batch.
//@ group_start
    if (item == 0) termination_depths[tile] = UINT_MAX;
//@ voted
        if (!alive && item == 0 && batch > start
//@@ termination_known
            ) termination_depths[tile] = keys[lists[batch - 1]];
