// Loop through a tile's list in segments, for CPUs: each segment block by block, so that a block's pixels stay in registers.
//@ blend_types
#define SEGMENT 64
//@ tile_loop
    for (uint segment = starts[tile] - base, end = starts[tile + 1] - base, length; segment < end && alive; segment += length) {
        length = min(end - segment, (uint)SEGMENT);
//@@ segment_of_layers
//@@ tile_loop_segment
        int touched[SEGMENT];                 // bit mask of the blocks that each splat overlaps
        for (int at = 0; at < SEGMENT; at += LANES) VSTORE((vint)0, touched + at);
        for (uint which = 0; which < length; which++) {
            PREFETCH(splats + lists[min(segment + which + PREFETCH_SPLATS, end - 1)]);
            PREFETCH((global const char *)(splats + lists[min(segment + which + PREFETCH_SPLATS, end - 1)]) + 64);
            const Splat s = splats[lists[segment + which]];
            touched[which] = (int)touched_blocks(&s, x0, y0, s.log_opacity - constants.log_alpha_cutoff, constants.sample_area
//@@ blocks_arguments
            );
        }
        for (uint blocks = alive; blocks != 0; blocks &= blocks - 1) {
            const int block = 31 - clz((int)(blocks & -blocks));
            ulong own = 0;                  // splats of the block
            for (int at = 0; at < SEGMENT; at += LANES)
                own |= (ulong)VBITS(VMASK((VLOAD(touched + at) & (int)(1u << block)) != 0)) << at;
            Pixel pixel = pixels[block];
            for (; own != 0; own &= own - 1) {
                const uint k = segment + 63 - (uint)clz(own & -own);
                const Splat s = splats[lists[k]];
                blend_real half_r2 = s.log_opacity - constants.log_alpha_cutoff;
//@ tile_loop_end
            }
            pixels[block] = pixel;
        }
    }
