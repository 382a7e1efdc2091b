// normal_world (h, w, 3): the normal in the axes of the world.
//@ resolve_args
    , global float *restrict normal_world_out
//@ resolve_end
    normal_world_out[3 * out] = normal_scale * FMA(turn_00, normal_x, FMA(turn_10, normal_y, turn_20 * normal_z));
    normal_world_out[3 * out + 1] = normal_scale * FMA(turn_01, normal_x, FMA(turn_11, normal_y, turn_21 * normal_z));
    normal_world_out[3 * out + 2] = normal_scale * FMA(turn_02, normal_x, FMA(turn_12, normal_y, turn_22 * normal_z));
