// Prefix sums of a stable counting sort without atomics: a list is cut into SORT_BLOCKS contiguous blocks, and each block counts its
// bins in its own row of table[SORT_BLOCKS][bins]. These kernels turn the counts into offsets.

// Index space: one work-item per bin and list.
// Reads and writes: table (counts become offsets within the bin). Writes: totals[bins].
kernel void scan_blocks(
//@@ arguments scan_blocks
) {
    uint bin = get_global_id(0), view_index = get_global_id(1);
    if (bin >= bins) return;
    table += (size_t)view_index * SORT_BLOCKS * bins;
    uint sum = 0;
    for (uint block = 0; block < SORT_BLOCKS; block++) {
        uint here = table[(size_t)block * bins + bin];
        table[(size_t)block * bins + bin] = sum;
        sum += here;
    }
    totals[view_index * bins + bin] = sum;
}

// Index space: one work-group of SCAN_ITEMS for each list.
// Reads: totals[bins]. Writes: starts[bins + 1], exclusive prefix; the list's counters [counter] and [counter + 1], the sum in 64 bits.
kernel void scan_bins(
//@@ arguments scan_bins
) {
    local ulong partial[SCAN_ITEMS + 1];
    uint item = get_local_id(0), view_index = get_global_id(1);
    totals += view_index * bins; starts += view_index * (bins + 1); counters += view_index * COUNTERS;
    uint block_size = (bins + SCAN_ITEMS - 1) / SCAN_ITEMS;
    uint from = min(item * block_size, bins), to = min(from + block_size, bins);
    ulong sum = 0;
    for (uint bin = from; bin < to; bin++) sum += totals[bin];
    partial[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        ulong running = 0;
        for (uint k = 0; k < SCAN_ITEMS; k++) {
            ulong here = partial[k];
            partial[k] = running;
            running += here;
        }
        partial[SCAN_ITEMS] = running;
        starts[bins] = (uint)running;
        counters[counter] = (uint)running;
        counters[counter + 1] = (uint)(running >> 32);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    sum = partial[item];
    for (uint bin = from; bin < to; bin++) {
        starts[bin] = (uint)sum;
        sum += totals[bin];
    }
}
