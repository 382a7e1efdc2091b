// Gradient with respect to the camera in a training step: its sums over the splats of each work-group.

//@ step_local
    local real camera[10][STEP_ITEMS];
    for (int k = 0; k < 10; k++) camera[k][get_local_id(0)] = 0;

//@ step_gradient
        for (int k = 0; k < 10; k++) camera[k][item] = splat_grad.grad_camera[k];

//@ step_sums
    if (item < 10) {
        real sum = 0;
        for (uint other = 0; other < STEP_ITEMS; other++) sum += camera[item][other];
        camera_sums[10 * get_group_id(0) + item] = sum;
    }
