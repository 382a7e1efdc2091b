// Stable least-significant-digit radix sort of (depth key, splat index). The first pass drops culled splats. The splats of each
// view are one list with `count` entries.
// Index space of both kernels: one work-item per block and view.

#define RADIX_BINS (1u << RADIX_BITS)

// Reads: keys, counters[COUNTER_VISIBLE] of the view unless `first`. Writes: this block's row of table.
kernel void sort_count(
//@@ arguments sort_count
) {
    uint block = get_global_id(0), view_index = get_global_id(1);
    if (block >= SORT_BLOCKS) return;
    keys += view_index * count;
    counters += view_index * COUNTERS;
    global uint *row = table + ((size_t)view_index * SORT_BLOCKS + block) * RADIX_BINS;
    for (uint bin = 0; bin < RADIX_BINS; bin++) row[bin] = 0;
    uint length = first ? count : counters[COUNTER_VISIBLE], block_size = (length + SORT_BLOCKS - 1) / SORT_BLOCKS;
    uint from = min(block * block_size, length), to = min(from + block_size, length);
    for (uint k = from; k < to; k++)
        if (keys[k] != CULLED) row[(keys[k] >> shift) & (RADIX_BINS - 1)]++;
}

// Reads: keys, indices (in the first pass the index is the position), starts. Reads and overwrites: table.
// Writes: keys_out, indices_out.
kernel void sort_scatter(
//@@ arguments sort_scatter
) {
    uint block = get_global_id(0), view_index = get_global_id(1), before = view_index * count;
    if (block >= SORT_BLOCKS) return;
    keys += before; indices += before; keys_out += before; indices_out += before;
    counters += view_index * COUNTERS;
    starts += view_index * (RADIX_BINS + 1);
    global uint *row = table + ((size_t)view_index * SORT_BLOCKS + block) * RADIX_BINS;
    uint length = first ? count : counters[COUNTER_VISIBLE], block_size = (length + SORT_BLOCKS - 1) / SORT_BLOCKS;
    uint from = min(block * block_size, length), to = min(from + block_size, length);
    for (uint k = from; k < to; k++) {
        uint key = keys[k];
        if (key == CULLED) continue;
        uint bin = (key >> shift) & (RADIX_BINS - 1);
        uint position = starts[bin] + row[bin]++;
        keys_out[position] = key;
        indices_out[position] = first ? before + k : indices[k];
    }
}
