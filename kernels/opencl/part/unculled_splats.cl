// Frustum culling by bounding spheres before projection, with stream compaction, for large clouds on GPUs: `unculled` holds the indices
// of the splats that pass, in ascending order. Only these have records and keys, so the warps of `project` have no idle work-items.
//@ functions
#define UNCULLED
#define UNCULLED_ITEMS 256
#define UNCULLED_SPLATS (16 * UNCULLED_ITEMS)            // splats of a work-group
#define UNCULLED_WORDS (UNCULLED_SPLATS / 32)
//@ unculled
    if (i >= counters[COUNTER_VISIBLE]) return;
    i = unculled[i];
//@ project_kernels
// Index space of both kernels: work-groups of UNCULLED_ITEMS, one for UNCULLED_SPLATS splats.
// Writes: unculled_bits, one bit per splat; unculled_counts, their sum for each work-group.
kernel __attribute__((reqd_work_group_size(UNCULLED_ITEMS, 1, 1))) void find_unculled(
//@@ arguments find_unculled
) {
    local uint words[UNCULLED_WORDS], total;
    uint item = get_local_id(0), first = get_group_id(0) * UNCULLED_SPLATS;
    if (item == 0) total = 0;
    if (item < UNCULLED_WORDS) words[item] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < UNCULLED_SPLATS && first + k < count; k += UNCULLED_ITEMS) {
        uint key = sphere_key(
//@@ passed project
            , first + k, 0);
        if (key != CULLED) atomic_or(words + k / 32, 1u << k % 32);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < UNCULLED_WORDS) {
        unculled_bits[first / 32 + item] = words[item];
        atomic_add(&total, popcount(words[item]));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) unculled_counts[get_group_id(0)] = total;
}

// Reads: unculled_bits, unculled_counts. Writes: unculled, at most `capacity` splats; counters' number of visible splats. If more than
// `capacity` splats pass, the counter of the first tile is set to 2^31, so that the frame is treated as overflowed.
kernel __attribute__((reqd_work_group_size(UNCULLED_ITEMS, 1, 1))) void list_unculled(
//@@ arguments list_unculled
) {
    local uint sums[UNCULLED_ITEMS], ends[UNCULLED_WORDS];
    uint item = get_local_id(0), group = get_group_id(0), first = group * UNCULLED_SPLATS, sum = 0;
    for (uint other = item; other < group; other += UNCULLED_ITEMS) sum += unculled_counts[other];
    sums[item] = sum;
    if (item < UNCULLED_WORDS) ends[item] = popcount(unculled_bits[first / 32 + item]);
    barrier(CLK_LOCAL_MEM_FENCE);
    // inclusive scans: sums[UNCULLED_ITEMS - 1] is the count of all earlier work-groups; ends: counts of the words
    for (uint step = 1; step < UNCULLED_ITEMS; step *= 2) {
        uint before = item >= step ? sums[item - step] : 0, above = item >= step && item < UNCULLED_WORDS ? ends[item - step] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        sums[item] += before;
        if (item < UNCULLED_WORDS) ends[item] += above;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    uint start = sums[UNCULLED_ITEMS - 1], total = start + ends[UNCULLED_WORDS - 1];
    for (uint k = item; k < UNCULLED_SPLATS; k += UNCULLED_ITEMS) {
        uint bits = unculled_bits[(first + k) / 32], bit = 1u << k % 32;
        uint position = start + ends[k / 32] - popcount(bits & ~(bit - 1));
        if ((bits & bit) != 0 && position < capacity) unculled[position] = first + k;
    }
    if (item == 0 && group == get_num_groups(0) - 1) {
        counters[COUNTER_VISIBLE] = total;
        if (total > capacity) counters[COUNTERS] = 0x80000000u;
    }
}
