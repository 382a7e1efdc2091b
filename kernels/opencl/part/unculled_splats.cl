// Frustum culling before projection, with stream compaction, for large clouds on GPUs: groups of CULLING_GROUP splats that are neighbours in
// Morton order are culled by a bounding sphere. `unculled` holds the groups that pass, in any order. Only their splats have records and keys.
//@ functions
#define CULLING_GROUP 32
#define CULL_ITEMS 256
//@ unculled
    if (i / CULLING_GROUP >= counters[COUNTER_VISIBLE]) return;
    i = unculled[i / CULLING_GROUP] * CULLING_GROUP + i % CULLING_GROUP;
//@ pair_order_parameters
                              , global const uint *unculled, global const int *splat_ids
//@ pair_order_arguments
                              , unculled, splat_ids
//@ pair_order
#define CULLING_GROUP 32
#define CLOUD_INDEX(pair) splat_ids[unculled[(uint)(pair) / CULLING_GROUP] * CULLING_GROUP + (uint)(pair) % CULLING_GROUP]
// Splats of equal depth are sorted by their index in the cloud.
static inline bool pair_before(ulong a, ulong b
//@@ pair_order_parameters
) {
    return a >> 32 == b >> 32 ? CLOUD_INDEX(a) < CLOUD_INDEX(b) : a < b;
}
#define PAIR_BEFORE(a, b) pair_before(a, b, unculled, splat_ids)
// By depth; pairs of equal depth are counted, and sorted after the loop.
#define COUNT_BEFORE(position, other, pair) do { \
        uint other_key = (uint)((other) >> 32); \
        position += other_key < (uint)((pair) >> 32); \
        equal += other_key == (uint)((pair) >> 32); \
    } while (0)
//@ equal_start
        uint equal = 0;
//@ equal_sorted
        for (uint other = first; equal > 1 && other < buckets->starts[bucket]; other++)
            position += BUCKETED(other) >> 32 == pair >> 32 && PAIR_BEFORE(BUCKETED(other), pair);
//@ project_kernels
// Index space: one work-item per group of splats, in work-groups of CULL_ITEMS.
// Reads: view, spheres, max_scales. Writes: unculled, at most `capacity` groups; adds to counters' number of visible splats. If more groups
// pass, the counter of the first tile is set to 2^31, so that the frame is treated as overflowed.
kernel __attribute__((reqd_work_group_size(CULL_ITEMS, 1, 1))) void cull_groups(
//@@ arguments cull_groups
) {
    local uint length, start;
    uint group = get_global_id(0), position = 0;
    if (get_local_id(0) == 0) length = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    bool passes = false;
    if (group < groups) {
        float4 sphere = spheres[group];
        real3_ center = {sphere.x, sphere.y, sphere.z};
        passes = frustum_key(view, center, sphere.w, max_scales[group]) != CULLED;
    }
    if (passes) position = atomic_inc(&length);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0) start = atomic_add(counters + COUNTER_VISIBLE, length);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (!passes) return;
    position += start;
    if (position < capacity) unculled[position] = group;
    else counters[COUNTERS] = 0x80000000u;
}
