// Gradient with respect to the camera pose in a training step: its sums over the splats of each work-group.

//@ step_local
    local real pose[6][STEP_ITEMS];
    for (int k = 0; k < 6; k++) pose[k][get_local_id(0)] = 0;

//@ step_gradient
        pose[0][item] = own.by_rotation.x;
        pose[1][item] = own.by_rotation.y;
        pose[2][item] = own.by_rotation.z;
        pose[3][item] = own.by_translation.x;
        pose[4][item] = own.by_translation.y;
        pose[5][item] = own.by_translation.z;

//@ step_sums
    if (item < 6) {
        real sum = 0;
        for (uint other = 0; other < STEP_ITEMS; other++) sum += pose[item][other];
        group_sums[6 * get_group_id(0) + item] = sum;
    }
