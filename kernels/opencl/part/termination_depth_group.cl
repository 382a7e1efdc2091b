// Termination depths of tiles for GPUs (part/termination_depth_lanes.cl), after each vote. There is no vote after the last staged splats.
//@ group_start
    if (item == 0) termination_depths[tile] = UINT_MAX;
//@ voted
        if (!alive && item == 0 && staged_start > start
//@@ termination_known
            ) termination_depths[tile] = keys[lists[staged_start - 1]];
