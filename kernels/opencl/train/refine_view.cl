// Refinement of training views: poses and intrinsics, which are members of the records View, and exposures. Poses are relative to the cloud's origin,
// so that float32, on devices without float64, also suffices far from the world's origin: rounding moves a camera by 1e-7 of the scene's
// size, less than the last steps of the optimiser. NumPy version: fidsplat/train/view_refinement.py.
#define REFINE_ITEMS 240   // a multiple of the columns, 10 and 6

// Step of a pose. camera: the record View of the view. gradient: with respect to rotation and translation of the camera.
static inline void refine_pose_of(
    global View *camera, local const real *gradient, real depth, global real *moments, real beta1, real beta2, real rate
) {
    // rotation about the point at `depth` on the optical axis, and translation in units of the depth
    real by_pose[6] = {gradient[0] + depth * gradient[4], gradient[1] - depth * gradient[3], gradient[2],
                       depth * gradient[3], depth * gradient[4], depth * gradient[5]};
    real motion[6], pose[12], rotation[9];
    view_adam(by_pose, 3, moments, beta1, beta2, rate, motion);
    for (int k = 3; k < 6; k++) motion[k] *= depth;
    // the rotation about the camera moves that point; move it back
    rotation_of(motion, rotation);
    for (int k = 0; k < 3; k++) motion[3 + k] -= depth * (rotation[3 * k + 2] - (k == 2));
    global real *record = (global real *)camera;
    for (int k = 0; k < 12; k++) pose[k] = record[k];
    move(pose, motion, record);
}

// Sums of columns from the partial sum of each work-item. result: (columns).
static inline void column_sums(real sum, uint columns, local real *partial, local real *result) {
    uint item = get_local_id(0);
    partial[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < columns) {
        for (uint k = item + columns; k < REFINE_ITEMS; k += columns) sum += partial[k];
        result[item] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Index space: one work-group of REFINE_ITEMS. Reads: the sums of the work-groups of project_step, and of exposure_backward or loss_sums. Updates, if
// `update`, by the flags `refine_*`: pose, sums of the gradients with respect to the intrinsics, and exposure of a view, with their moments.
// Writes: `view`, the record of the next frame, which then need not be copied.
kernel __attribute__((reqd_work_group_size(REFINE_ITEMS, 1, 1))) void refine_view(
//@@ arguments refine_view
) {
    local real partial[REFINE_ITEMS], by_camera[10], by_exposure[6];
    uint item = get_local_id(0);
    real camera_sum = 0, exposure_sum = 0;
    for (uint k = item; k < 10 * groups; k += REFINE_ITEMS) camera_sum += camera_sums[k];
    column_sums(camera_sum, 10, partial, by_camera);
    if (refine_exposure)
        for (uint k = item; k < 6 * exposure_groups; k += REFINE_ITEMS) exposure_sum += exposure_sums[k];
    column_sums(exposure_sum, 6, partial, by_exposure);
    if (item == 0 && update && refine_pose)
        refine_pose_of(views + view_index, by_camera, depths[view_index], pose_moments + 12 * view_index, beta1, beta2, pose_rate);
    if (item == 0 && update && refine_intrinsics)
        for (uint k = 0; k < 4; k++) intrinsics_sums[4 * intrinsics_rows[view_index] + k] += by_camera[6 + k];
    if (item == 0 && update && refine_exposure) {
        real gradient[6], change[6];
        for (uint k = 0; k < 6; k++) gradient[k] = by_exposure[k];
        view_adam(gradient, 3, exposure_moments + 12 * view_index, beta1, beta2, exposure_rate, change);
        for (uint k = 0; k < 6; k++) exposures[6 * view_index + k] += (float)change[k];
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (uint k = item; k < sizeof(View) / sizeof(real); k += REFINE_ITEMS) ((global real *)view)[k] = ((global const real *)(views + next_view))[k];
}

// Index space: one work-group of INTRINSICS_ITEMS. Updates: a row of the intrinsics, its moments and sums, and the intrinsics of all views that have
// them. The limits of EWA outside of the image remain those of the data set's intrinsics.
#define INTRINSICS_ITEMS 64
kernel __attribute__((reqd_work_group_size(INTRINSICS_ITEMS, 1, 1))) void refine_intrinsics(
//@@ arguments refine_intrinsics
) {
    local real values[4];
    if (get_local_id(0) == 0) {
        global real *current = intrinsics + 4 * intrinsics_row, *sums = intrinsics_sums + 4 * intrinsics_row;
        real focal[2] = {current[0], current[1]}, gradient[4], change[4];
        for (int k = 0; k < 4; k++) gradient[k] = sums[k] * focal[k % 2];
        view_adam(gradient, 2, intrinsics_moments + 8 * intrinsics_row, beta1, beta2, intrinsics_rate, change);
        for (int k = 0; k < 4; k++) {
            values[k] = current[k] += focal[k % 2] * change[k];
            sums[k] = 0;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = get_local_id(0); i < count; i += INTRINSICS_ITEMS) {
        if (intrinsics_rows[i] != intrinsics_row) continue;
        global View *view = views + i;
        view->focal_x = values[0]; view->focal_y = values[1]; view->center_x = values[2]; view->center_y = values[3];
        for (int k = 0; k < 4; k++) lenses[4 * i + k] = (float)values[k];
    }
}
