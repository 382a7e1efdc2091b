// Stable least-significant-digit radix sort of (depth key, splat index). The first pass drops culled splats. The splats of each
// view are one list with `count` entries.
// Index space of both kernels: one work-item per chunk and view.

#define RADIX_BINS (1u << RADIX_BITS)

// Reads: keys, the view's number of visible splats unless `first`. Writes: this chunk's row of table.
kernel void sort_count(
//@@ arguments sort_count
) {
    uint chunk = get_global_id(0), number = get_global_id(1);
    if (chunk >= CHUNKS) return;
    keys += number * count;
    counters += number * COUNTERS;
    global uint *row = table + ((size_t)number * CHUNKS + chunk) * RADIX_BINS;
    for (uint bin = 0; bin < RADIX_BINS; bin++) row[bin] = 0;
    uint length = first ? count : counters[COUNTER_VISIBLE], each = (length + CHUNKS - 1) / CHUNKS;
    uint from = min(chunk * each, length), to = min(from + each, length);
    for (uint k = from; k < to; k++)
        if (keys[k] != CULLED) row[(keys[k] >> shift) & (RADIX_BINS - 1)]++;
}

// Reads: keys, indices (in the first pass the index is the position), starts. Consumes: table.
// Writes: keys_out, indices_out.
kernel void sort_scatter(
//@@ arguments sort_scatter
) {
    uint chunk = get_global_id(0), number = get_global_id(1), before = number * count;
    if (chunk >= CHUNKS) return;
    keys += before; indices += before; keys_out += before; indices_out += before;
    counters += number * COUNTERS;
    starts += number * (RADIX_BINS + 1);
    global uint *row = table + ((size_t)number * CHUNKS + chunk) * RADIX_BINS;
    uint length = first ? count : counters[COUNTER_VISIBLE], each = (length + CHUNKS - 1) / CHUNKS;
    uint from = min(chunk * each, length), to = min(from + each, length);
    for (uint k = from; k < to; k++) {
        uint key = keys[k];
        if (key == CULLED) continue;
        uint bin = (key >> shift) & (RADIX_BINS - 1);
        uint place = starts[bin] + row[bin]++;
        keys_out[place] = key;
        indices_out[place] = first ? before + k : indices[k];
    }
}
