// Compaction for clouds that are projected in slices: appends the visible splats of a slice to those of preceding slices, in
// order. The slice is cut into SORT_BLOCKS blocks; the host adds up their counts.

// Index space: one work-item per block. Reads: keys. Writes: block_counts[0 .. SORT_BLOCKS): splats of the block in this band,
// block_counts[SORT_BLOCKS .. 2 * SORT_BLOCKS): splats of the block in any band.
kernel void pack_count(
//@@ arguments pack_count
) {
    uint block = get_global_id(0);
    if (block >= SORT_BLOCKS) return;
    uint block_size = (count + SORT_BLOCKS - 1) / SORT_BLOCKS;
    uint from = min(block * block_size, count), to = min(from + block_size, count), packed = 0, visible = 0;
    for (uint k = from; k < to; k++) {
        packed += keys[k] < OUT_OF_BAND;
        visible += keys[k] != CULLED;
    }
    block_counts[block] = packed;
    block_counts[SORT_BLOCKS + block] = visible;
}

// Index space: one work-item per block. Reads: block_offsets (output index of each block), splats, keys, windows.
// Writes: splats_out, keys_out, windows_out.
kernel void pack_move(
//@@ arguments pack_move
) {
    uint block = get_global_id(0);
    if (block >= SORT_BLOCKS) return;
    uint block_size = (count + SORT_BLOCKS - 1) / SORT_BLOCKS;
    uint from = min(block * block_size, count), to = min(from + block_size, count), offset = block_offsets[block];
    for (uint k = from; k < to; k++)
        if (keys[k] < OUT_OF_BAND) {
            splats_out[offset] = splats[k];
            keys_out[offset] = keys[k];
            windows_out[offset] = windows[k];
            offset++;
        }
}
