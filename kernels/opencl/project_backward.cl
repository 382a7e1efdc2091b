// Gradients with respect to the cloud's arrays and the camera, from those of project_splat_backward.cl.
// Index space: one work-item per splat, in groups of POSE_ITEMS.
// Reads:  view, the cloud, splats, keys, windows, big_bounds, gradient_offsets, record_gradients.
// Writes: gradients with respect to the cloud's arrays, 0 for culled splats; camera_sums, with respect to the camera.
// CLOUD_COEFFICIENTS, GRAD_COEFFICIENTS, SH_COEFFICIENTS: from effect/color_*_backward.cl.
#define POSE_ITEMS 64
kernel __attribute__((reqd_work_group_size(POSE_ITEMS, 1, 1))) void project_backward(
//@@ arguments project_backward
) {
    local real camera[10][POSE_ITEMS];
    uint i = get_global_id(0), item = get_local_id(0);
    SplatGradient splat_grad = {{0}};
    if (i < count) {
        splat_grad = splat_gradient(
            i, view, means, quats, scales, opacities, CLOUD_COEFFICIENTS, SH_COEFFICIENTS, splats, keys, windows, big_capacity, big_bounds, width,
            height, gradient_offsets, record_gradients
//@@ footprint_arguments
        );
        for (int k = 0; k < 3; k++) grad_means[3 * i + k] = splat_grad.mean[k];
        for (int k = 0; k < 4; k++) grad_quats[4 * i + k] = splat_grad.quat[k];
        for (int k = 0; k < 2; k++) grad_scales[2 * i + k] = splat_grad.scale[k];
        grad_opacities[i] = splat_grad.opacity;
        grad2d[i] = splat_grad.grad2d;
//@@ footprint_results
        global float *grad_terms = GRAD_COEFFICIENTS + (size_t)i * SH_COEFFICIENTS * 3;
        for (int k = 0; k < SH_COEFFICIENTS; k++)
            for (int c = 0; c < 3; c++) grad_terms[3 * k + c] = splat_grad.basis[k] * splat_grad.color[c];
    }
    for (int k = 0; k < 10; k++) camera[k][item] = splat_grad.grad_camera[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 10) {
        real sum = 0;
        for (uint other = 0; other < POSE_ITEMS; other++) sum += camera[item][other];
        camera_sums[10 * get_group_id(0) + item] = sum;
    }
}

// Sums over rows in a fixed order.
// Index space: work-groups of SUM_ITEMS, one per column: three of background_sums, then ten of camera_sums. Writes: background, pose, intrinsics.
#define SUM_ITEMS 64
kernel __attribute__((reqd_work_group_size(SUM_ITEMS, 1, 1))) void sum_gradients(
//@@ arguments sum_gradients
) {
    local real partial[SUM_ITEMS];
    bool of_tiles = get_group_id(0) < 3;
    global const real *parts = of_tiles ? background_sums : camera_sums;
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
