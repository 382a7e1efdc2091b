// Gradient of depth = sum w z / sum w.
//@ pixel_gradient
    vfloat depth, depth_weight;
//@ pixel_gradient_start
        vfloat depth_sum = BLOCK_LOAD(depth_raw + at, stride), weight_sum = BLOCK_LOAD(depth_raw + channel_stride + at, stride);
        vint has_depth = VMASK(weight_sum > 0.0f);
        weight_sum = VSELECT((vfloat)1.0f, weight_sum, has_depth);
        gradient->depth = VSELECT((vfloat)0.0f, pixels_of(grad_depth, 1, 0, x, y, width, height) / weight_sum, has_depth);
        gradient->depth_weight = -gradient->depth * (depth_sum / weight_sum);
//@ grad_weight
    grad_weight += FMA(gradient->depth, g->z, gradient->depth_weight);
//@ fragment_backward
    grad_d += add_depth(sums, s, g, weight * gradient->depth, lowpass_half_rho, x, y, &grad_nu, &grad_nv);
