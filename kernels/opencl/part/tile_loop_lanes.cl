// Loop through a tile's list in chunks, for CPUs: each chunk block by block, so that a block's pixels stay in registers.
//@ blend_types
#define CHUNK 64
//@ tile_loop
    for (uint chunk = starts[tile] - base, end = starts[tile + 1] - base, length; chunk < end && alive; chunk += length) {
        length = min(end - chunk, (uint)CHUNK);
//@@ chunk_of_layers
//@@ tile_loop_chunk
        int touched[CHUNK];                 // bit mask of the blocks that each splat overlaps
        for (int at = 0; at < CHUNK; at += LANES) VSTORE((vint)0, touched + at);
        for (uint which = 0; which < length; which++) {
            PREFETCH(splats + lists[min(chunk + which + PREFETCH_SPLATS, end - 1)]);
            PREFETCH((global const char *)(splats + lists[min(chunk + which + PREFETCH_SPLATS, end - 1)]) + 64);
            const Splat s = splats[lists[chunk + which]];
            touched[which] = (int)touched_blocks(&s, x0, y0, s.log_opacity - constants.log_alpha_cutoff, constants.sample_area
//@@ blocks_arguments
            );
        }
        for (uint blocks = alive; blocks != 0; blocks &= blocks - 1) {
            const int block = 31 - clz((int)(blocks & -blocks));
            ulong own = 0;                  // splats of the block
            for (int at = 0; at < CHUNK; at += LANES)
                own |= (ulong)VBITS(VMASK((VLOAD(touched + at) & (int)(1u << block)) != 0)) << at;
            Pixel pixel = pixels[block];
            for (; own != 0; own &= own - 1) {
                const uint k = chunk + 63 - (uint)clz(own & -own);
                const Splat s = splats[lists[k]];
                blend_real half_r2 = s.log_opacity - constants.log_alpha_cutoff;
//@ tile_loop_end
            }
            pixels[block] = pixel;
        }
    }
