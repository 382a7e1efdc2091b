// Activations of the trained parameters, and visibility counts.

// Index space: one work-item per splat. Reads: the parameters. Writes: unit quaternions, scales, opacities.
kernel void activate(
//@@ arguments activate
) {
    size_t i = get_global_id(0);
    if (i >= count) return;
    vstore4(unit(vload4(i, quats)), i, activated_quats);
    for (uint k = 0; k < 2; k++) activated_scales[2 * i + k] = EXP(log_scales[axes * i + k]);
    if (axes == 3) activated_thickness[i] = EXP(log_scales[axes * i + 2]);
    activated_opacities[i] = sigmoid(logits[i]);
}

// Index space: one work-item per splat and rendered coefficient of a channel. Reads: sh, of `stored_coefficients` coefficients. Writes: the first
// `rendered_coefficients` of them, packed; at degree 0, if `as_rgb`, the RGB colours.
kernel void activate_sh(
//@@ arguments activate_sh
) {
    uint k = get_global_id(0);
    if (k >= count * 3 * rendered_coefficients) return;
    float value = sh[k / (3 * rendered_coefficients) * 3 * stored_coefficients + k % (3 * rendered_coefficients)];
    activated_sh[k] = as_rgb ? plain_color(value) : value;
}

// Index space: one work-item per splat. Reads: means, scales. Updates: the number of frames in whose frustum the splat was, by a
// sphere of three standard deviations.
kernel void count_visible(
//@@ arguments count_visible
) {
    size_t i = get_global_id(0);
    if (i >= count) return;
    float3 p = vload3(i, means);
    float x = rotation_00 * p.x + rotation_01 * p.y + rotation_02 * p.z + translation_x;
    float y = rotation_10 * p.x + rotation_11 * p.y + rotation_12 * p.z + translation_y;
    float z = rotation_20 * p.x + rotation_21 * p.y + rotation_22 * p.z + translation_z;
    float reach = 3.0f * fmax(activated_scales[2 * i], activated_scales[2 * i + 1]);
    if (axes == 3) reach = fmax(reach, 3.0f * activated_thickness[i]);
    // pixels times depth, so that nothing is divided by a depth of 0
    float u = focal_x * x + center_x * z, v = focal_y * y + center_y * z;
    bool inside = z > near && u + focal_x * reach > 0.0f && u - focal_x * reach < width * z && v + focal_y * reach > 0.0f
        && v - focal_y * reach < height * z;
    visible_counts[i] += inside ? 1.0f : 0.0f;
}
