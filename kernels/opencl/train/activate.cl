// Activations of the trained parameters.

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
