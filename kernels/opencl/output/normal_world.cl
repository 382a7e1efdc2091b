// normal_world (h, w, 3): the normal in world axes.
//@ resolve_end
    for (int axis = 0; axis < 3; axis++)
        normal_world_out[3 * out + axis] =
            normal_scale * FMA(row_rotation[axis], normal_x, FMA(row_rotation[3 + axis], normal_y, row_rotation[6 + axis] * normal_z));
