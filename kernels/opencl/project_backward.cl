// Gradients with respect to the cloud's arrays and the camera, from those of set_up_backward.cl.
// Index space: one work-item per splat, in groups of POSE_ITEMS.
// Reads:  view, the cloud, splats, keys, windows, big_bounds, splat_slots, moments.
// Writes: gradients with respect to the cloud's arrays, 0 for culled splats; group_sums, with respect to the camera.
#define POSE_ITEMS 64
kernel __attribute__((reqd_work_group_size(POSE_ITEMS, 1, 1))) void project_backward(
//@@ arguments project_backward
) {
    local real camera[10][POSE_ITEMS];
    uint i = get_global_id(0), item = get_local_id(0);
    SplatGradient own = {{0}};
    if (i < count) {
        own = splat_gradient(
            i, view, means, quats, scales, opacities, CLOUD_TERMS, SH_TERMS, splats, keys, windows, big_capacity, big_bounds, width,
            height, splat_slots, moments
//@@ footprint_arguments
        );
        for (int k = 0; k < 3; k++) by_means[3 * i + k] = own.mean[k];
        for (int k = 0; k < 4; k++) by_quats[4 * i + k] = own.quat[k];
        for (int k = 0; k < 2; k++) by_scales[2 * i + k] = own.scale[k];
        by_opacities[i] = own.opacity;
        screen[i] = own.screen;
//@@ footprint_results
        global float *by_terms = BY_TERMS + (size_t)i * SH_TERMS * 3;
        for (int k = 0; k < SH_TERMS; k++)
            for (int c = 0; c < 3; c++) by_terms[3 * k + c] = own.basis[k] * own.color[c];
    }
    for (int k = 0; k < 10; k++) camera[k][item] = own.by_camera[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 10) {
        real sum = 0;
        for (uint other = 0; other < POSE_ITEMS; other++) sum += camera[item][other];
        group_sums[10 * get_group_id(0) + item] = sum;
    }
}

// Sums over rows in a fixed order.
// Index space: work-groups of SUM_ITEMS, one per column: three of tile_sums, then ten of group_sums. Writes: background, pose, intrinsics.
#define SUM_ITEMS 64
kernel __attribute__((reqd_work_group_size(SUM_ITEMS, 1, 1))) void add_up(
//@@ arguments add_up
) {
    local real partial[SUM_ITEMS];
    bool of_tiles = get_group_id(0) < 3;
    global const real *parts = of_tiles ? tile_sums : group_sums;
    uint item = get_local_id(0), column = get_group_id(0) - (of_tiles ? 0 : 3);
    uint rows = of_tiles ? tiles : groups, columns = of_tiles ? 3 : 10;
    real sum = 0;
    for (uint row = item; row < rows; row += SUM_ITEMS) sum += parts[(size_t)row * columns + column];
    partial[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        for (uint other = 1; other < SUM_ITEMS; other++) sum += partial[other];
        *(of_tiles ? background + column : column < 6 ? pose + column : intrinsics + column - 6) = (float)sum;
    }
}
