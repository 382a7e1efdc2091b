// Refinement of the cameras of training views: their poses and intrinsics are members of the records View, from which frames copy theirs. They
// are relative to the cloud's origin, so that float32, on devices without float64, also suffices far from it: rounding moves a camera by 1e-7
// of the scene's size, less than the last steps of the optimiser. NumPy version: fidsplat/train/view_refinement.py.
#define CAMERA_ITEMS 240   // a multiple of the 10 columns

// Index space: one work-group of CAMERA_ITEMS. Reads: the sums of the work-groups of project_step. Updates: the pose of a view, its moments, and the
// sums of the gradients with respect to the intrinsics.
kernel __attribute__((reqd_work_group_size(CAMERA_ITEMS, 1, 1))) void refine_camera(
//@@ arguments refine_camera
) {
    local real partial[CAMERA_ITEMS], gradient[10];
    uint item = get_local_id(0);
    real sum = 0;
    for (uint k = item; k < 10 * groups; k += CAMERA_ITEMS) sum += camera_sums[k];
    partial[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 10) {
        for (uint k = item + 10; k < CAMERA_ITEMS; k += 10) sum += partial[k];
        gradient[item] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item > 0) return;
    for (uint k = 0; k < 4; k++) intrinsics_sums[4 * intrinsics_row + k] += gradient[6 + k];
    if (!refine_pose) return;
    // rotation about the point at `depth` on the optical axis, and translation in units of the depth
    real by_pose[6] = {gradient[0] + depth * gradient[4], gradient[1] - depth * gradient[3], gradient[2],
                       depth * gradient[3], depth * gradient[4], depth * gradient[5]};
    real motion[6], pose[12];
    view_adam(by_pose, 3, pose_moments + 12 * row, beta1, beta2, correction1, correction2, motion);
    for (int k = 0; k < 6; k++) motion[k] *= k < 3 ? rate : rate * depth;
    // the rotation about the camera moves that point; move it back
    real rotation[9];
    rotation_of(motion, rotation);
    for (int k = 0; k < 3; k++) motion[3 + k] -= depth * (rotation[3 * k + 2] - (k == 2));
    global real *record = (global real *)(views + row);
    for (int k = 0; k < 12; k++) pose[k] = record[k];
    move(pose, motion, record);
}

// Index space: one work-group of INTRINSICS_ITEMS. Updates: a row of the intrinsics, its moments and sums, and the intrinsics of all views that have
// them.
#define INTRINSICS_ITEMS 64
kernel __attribute__((reqd_work_group_size(INTRINSICS_ITEMS, 1, 1))) void refine_intrinsics(
//@@ arguments refine_intrinsics
) {
    local real values[4];
    if (get_local_id(0) == 0) {
        global real *current = intrinsics + 4 * intrinsics_row, *sums = intrinsics_sums + 4 * intrinsics_row;
        real focal[2] = {current[0], current[1]}, gradient[4], direction[4];
        for (int k = 0; k < 4; k++) gradient[k] = sums[k] * focal[k % 2];
        view_adam(gradient, 2, intrinsics_moments + 8 * intrinsics_row, beta1, beta2, correction1, correction2, direction);
        for (int k = 0; k < 4; k++) {
            values[k] = current[k] += rate * focal[k % 2] * direction[k];
            sums[k] = 0;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = get_local_id(0); i < count; i += INTRINSICS_ITEMS) {
        if (intrinsics_rows[i] != intrinsics_row) continue;
        global View *view = views + i;
        view->focal_x = values[0]; view->focal_y = values[1]; view->center_x = values[2]; view->center_y = values[3];
        for (int k = 0; k < 4; k++) lenses[4 * i + k] = (float)values[k];
//@@ intrinsics
    }
}
