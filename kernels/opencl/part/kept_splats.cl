// Frustum culling by bounding spheres before projection, for large clouds on GPUs: `kept` lists the other splats in order. Only they
// have records and keys, and complete warps set them up.
//@ functions
#define KEPT
#define KEPT_ITEMS 256
#define KEPT_SPLATS (16 * KEPT_ITEMS)            // splats of a work-group
#define KEPT_WORDS (KEPT_SPLATS / 32)
//@ kept
    if (i >= tallies[TALLY_VISIBLE]) return;
    i = kept[i];
//@ project_kernels
// Index space of both kernels: work-groups of KEPT_ITEMS, one for KEPT_SPLATS splats.
// Writes: kept_bits, one bit per splat; kept_counts, their sum for each work-group.
kernel __attribute__((reqd_work_group_size(KEPT_ITEMS, 1, 1))) void find_kept(
//@@ arguments find_kept
) {
    local uint words[KEPT_WORDS], total;
    uint item = get_local_id(0), first = get_group_id(0) * KEPT_SPLATS;
    if (item == 0) total = 0;
    if (item < KEPT_WORDS) words[item] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < KEPT_SPLATS && first + k < count; k += KEPT_ITEMS) {
        uint key = sphere_key(
//@@ passed project
            , first + k, 0);
        if (key != CULLED) atomic_or(words + k / 32, 1u << k % 32);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < KEPT_WORDS) {
        kept_bits[first / 32 + item] = words[item];
        atomic_add(&total, popcount(words[item]));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) kept_counts[get_group_id(0)] = total;
}

// Reads: kept_bits, kept_counts. Writes: kept, at most `capacity` splats; tallies' number of visible splats. With more than `capacity`,
// the first tile's tally makes all lists overflow.
kernel __attribute__((reqd_work_group_size(KEPT_ITEMS, 1, 1))) void list_kept(
//@@ arguments list_kept
) {
    local uint sums[KEPT_ITEMS], ends[KEPT_WORDS];
    uint item = get_local_id(0), group = get_group_id(0), first = group * KEPT_SPLATS, sum = 0;
    for (uint other = item; other < group; other += KEPT_ITEMS) sum += kept_counts[other];
    sums[item] = sum;
    if (item < KEPT_WORDS) ends[item] = popcount(kept_bits[first / 32 + item]);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = 1; step < KEPT_ITEMS; step *= 2) {     // sums[KEPT_ITEMS - 1]: of all; ends: inclusive prefix sums
        uint before = item >= step ? sums[item - step] : 0, above = item >= step && item < KEPT_WORDS ? ends[item - step] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        sums[item] += before;
        if (item < KEPT_WORDS) ends[item] += above;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    uint start = sums[KEPT_ITEMS - 1], total = start + ends[KEPT_WORDS - 1];
    for (uint k = item; k < KEPT_SPLATS; k += KEPT_ITEMS) {
        uint bits = kept_bits[(first + k) / 32], bit = 1u << k % 32;
        uint place = start + ends[k / 32] - popcount(bits & ~(bit - 1));
        if ((bits & bit) != 0 && place < capacity) kept[place] = first + k;
    }
    if (item == 0 && group == get_num_groups(0) - 1) {
        tallies[TALLY_VISIBLE] = total;
        if (total > capacity) tallies[TALLIES] = 0x80000000u;
    }
}
