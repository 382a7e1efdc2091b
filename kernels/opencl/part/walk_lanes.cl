// The way through a tile's list splat by splat, for CPUs: each splat at all blocks that it touches.
//@ walk
    for (uint k = starts[tile] - base, end = starts[tile + 1] - base; k < end && alive; k++) {
//@@ walked
        FETCH_AHEAD(splats + lists[min(k + AHEAD_SPLATS, end - 1)]);
        FETCH_AHEAD((global const char *)(splats + lists[min(k + AHEAD_SPLATS, end - 1)]) + 64);
        const Splat s = splats[lists[k]];
        wide half_r2 = s.log_opacity - constants.log_cut;
        for (uint touched = alive & touched_blocks(&s, x0, y0, half_r2, constants.filter); touched != 0; touched &= touched - 1) {
            int block = 31 - clz((int)(touched & -touched));
//@ walk_end
        }
    }
