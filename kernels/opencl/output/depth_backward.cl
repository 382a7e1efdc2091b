// depth = sum w z / sum w.
//@ loss
    vfloat depth, depth_weight;
//@ loss_start
        vfloat depth_sum = BLOCK_LOAD(depth_raw + at, stride), weight_sum = BLOCK_LOAD(depth_raw + channel_stride + at, stride);
        vint has_depth = VMASK(weight_sum > 0.0f);
        weight_sum = VSELECT((vfloat)1.0f, weight_sum, has_depth);
        loss->depth = VSELECT((vfloat)0.0f, pixels_of(by_depth, 1, 0, x, y, width, height) / weight_sum, has_depth);
        loss->depth_weight = -loss->depth * (depth_sum / weight_sum);
//@ worth
    worth += FMA(loss->depth, g->z, loss->depth_weight);
//@ fragment_backward
    by_d += add_depth(sums, s, g, weight * loss->depth, screen, x, y, &by_nu, &by_nv);
