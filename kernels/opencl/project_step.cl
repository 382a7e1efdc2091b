// Adam step on the gradients of set_up_backward.cl, which stay in local memory: in training it replaces project_backward.
// Index space: one work-item per splat, in groups of STEP_ITEMS.
// Reads:  view, splats, keys, windows, big_bounds, splat_slots, moments. Updates: if `counted`, the sums of screen-space gradients;
// if `move`, the parameters, Adam's moments, and the activated parameters.
#define STEP_ITEMS 64
#define VALUES (3 * SH_TERMS)       // rendered colour values per splat
#if LANES > 1 && !PLAIN
#define TERMS_CAPACITY 16               // a full vector
#else
#define TERMS_CAPACITY SH_TERMS
#endif
kernel __attribute__((reqd_work_group_size(STEP_ITEMS, 1, 1))) void project_step(
//@@ arguments project_step
) {
    local float by_means[3 * STEP_ITEMS], by_scales[AXES * STEP_ITEMS], by_quats[4 * STEP_ITEMS], by_opacities[STEP_ITEMS];
    local float by_colors[3 * STEP_ITEMS], basis[TERMS_CAPACITY * STEP_ITEMS];
    local uchar skipped[STEP_ITEMS];
//@@ step_local
    uint i = get_global_id(0), item = get_local_id(0), first = get_group_id(0) * STEP_ITEMS;
    if (i < count) {
        const SplatGradient own = splat_gradient(
            i, view, means, activated_quats, activated_scales, activated_opacities, sh, all, splats, keys, windows, big_capacity,
            big_bounds, width, height, splat_slots, moments
#if AXES == 3
            , activated_thickness
#endif
        );
        if (counted) gradient_sums[i] += own.screen;
        for (int k = 0; k < 3; k++) by_means[3 * item + k] = own.mean[k];
        for (int k = 0; k < 2; k++) by_scales[AXES * item + k] = own.scale[k];
#if AXES == 3
        by_scales[AXES * item + 2] = own.thickness;
#endif
        for (int k = 0; k < 4; k++) by_quats[4 * item + k] = own.quat[k];
        by_opacities[item] = own.opacity;
        for (int k = 0; k < 3; k++) by_colors[3 * item + k] = own.color[k];
        for (int k = 0; k < SH_TERMS; k++) basis[TERMS_CAPACITY * item + k] = own.basis[k];
        // parameters without gradient keep their values and Adam's moments
        bool depends = own.opacity != 0.0f;
        for (int k = 0; k < 3; k++) depends |= own.mean[k] != 0.0f || own.basis[0] * own.color[k] != 0.0f;
        skipped[item] = sparse && !depends;
//@@ step_gradient
    }
    barrier(CLK_LOCAL_MEM_FENCE);
//@@ step_sums
    if (!move) return;

#if LANES > 1
    // complete groups of 16 splats: vectors, by the first work-item of each
    bool vectorized = !sparse && (i | 15) < count;
    if (vectorized && item % 16 == 0) {
        for (uint k = 3 * item, at = 3 * i; k < 3 * item + 48; k += 16, at += 16)
            vstore16(ADAM_16(means, at, vload16(0, by_means + k), (float16)size_means), 0, means + at);
#if AXES == 2
        for (uint k = 2 * item, at = 2 * i; k < 2 * item + 32; k += 16, at += 16) {
            float16 gradient = (vload16(0, by_scales + k) + scale_penalty) * vload16(0, activated_scales + at);
            float16 value = ADAM_16(log_scales, at, gradient, (float16)size_scales);
            vstore16(value, 0, log_scales + at);
            vstore16(exp(value), 0, activated_scales + at);
        }
#endif
        for (uint k = 4 * item, at = 4 * i; k < 4 * item + 64; k += 16, at += 16) {
            float16 q = vload16(0, quats + at), by = vload16(0, by_quats + k);
            float16 length = sqrt(sums_of_4(q * q)), turn = q / length;
            by = (by - turn * sums_of_4(turn * by)) / length;
            q = ADAM_16(quats, at, by, (float16)size_quats);
            vstore16(q, 0, quats + at);
            vstore16(units(q), 0, activated_quats + at);
        }
        float16 opacity = vload16(0, activated_opacities + i);
        float16 gradient = (vload16(0, by_opacities + item) + opacity_penalty) * opacity * (1.0f - opacity);
        float16 value = ADAM_16(logits, i, gradient, (float16)size_logits);
        vstore16(value, 0, logits + i);
        vstore16(sigmoids(value), 0, activated_opacities + i);
    }
#else
    bool vectorized = false;
#endif
#if AXES == 3
    if (i < count && !skipped[item])
        for (uint k = 0; k < 3; k++) {
            global float *activated = k < 2 ? activated_scales + 2 * i + k : activated_thickness + i;
            ADAM(log_scales, 3 * i + k, (by_scales[3 * item + k] + scale_penalty) * *activated, size_scales);
            *activated = EXP(log_scales[3 * i + k]);
        }
#endif
    if (i < count && !vectorized && !skipped[item]) {
        for (uint k = 0; k < 3; k++) ADAM(means, 3 * i + k, by_means[3 * item + k], size_means);
#if AXES == 2
        for (uint k = 0; k < 2; k++) {
            uint at = 2 * i + k;
            ADAM(log_scales, at, (by_scales[2 * item + k] + scale_penalty) * activated_scales[at], size_scales);
            activated_scales[at] = EXP(log_scales[at]);
        }
#endif
        float4 q = vload4(i, quats), by = vload4(item, by_quats);
        float length = sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
        float4 turn = q / length;
        by = (by - turn * (turn.x * by.x + turn.y * by.y + turn.z * by.z + turn.w * by.w)) / length;
        ADAM(quats, 4 * i, by.x, size_quats);
        ADAM(quats, 4 * i + 1, by.y, size_quats);
        ADAM(quats, 4 * i + 2, by.z, size_quats);
        ADAM(quats, 4 * i + 3, by.w, size_quats);
        vstore4(unit(vload4(i, quats)), i, activated_quats);
        float opacity = activated_opacities[i];
        ADAM(logits, i, (by_opacities[item] + opacity_penalty) * opacity * (1.0f - opacity), size_logits);
        activated_opacities[i] = sigmoid(logits[i]);
    }

    // the rendered colours are the SH parameters, unless some degrees are not rendered or degree 0 is rendered as plain colours
    const bool separate = PLAIN || SH_TERMS < all;
#if LANES > 1 && !PLAIN
    if (i < count && !skipped[item]) {
        size_t row = i * (size_t)(3 * all), out = i * (size_t)VALUES;
        // value k belongs to term k / 3 and channel k % 3; values behind the last term are unused
        float16 b = vload16(0, basis + TERMS_CAPACITY * item), c = 0.0f;
        c.s012 = vload3(item, by_colors);
        const float16 by[3] = {
            b.s0001112223334445 * c.s0120120120120120,
            b.s55666777888999aa * c.s1201201201201201,
            b.sabbbcccdddeeefff * c.s2012012012012012,
        };
        uint k = 0;
        for (; k + 16 <= VALUES; k += 16) {
            float16 size = size_rest;
            if (k == 0) size.s012 = size_sh;
            float16 value = ADAM_16(sh, row + k, by[k / 16], size);
            vstore16(value, 0, sh + row + k);
            if (separate) vstore16(value, 0, activated_sh + out + k);
        }
        float last[16];
        vstore16(by[k / 16 % 3], 0, last);
        for (; k < VALUES; k++) {
            float value = ADAM(sh, row + k, last[k % 16], k < 3 ? size_sh : size_rest);
            if (separate) activated_sh[out + k] = value;
        }
    }
#else
    // the group's coefficients in memory order
    for (uint k = item; k < min(count - first, (uint)STEP_ITEMS) * VALUES; k += STEP_ITEMS) {
        uint which = k / VALUES, within = k % VALUES;
        if (skipped[which]) continue;
        size_t at = (first + which) * (size_t)(3 * all) + within;
        float gradient = basis[TERMS_CAPACITY * which + within / 3] * by_colors[3 * which + within % 3];
        if (PLAIN) gradient = SH_C0 * sh[at] + 0.5f > 0.0f ? SH_C0 * gradient : 0.0f;
        float value = ADAM(sh, at, gradient, within < 3 ? size_sh : size_rest);
        if (separate) activated_sh[(size_t)first * VALUES + k] = PLAIN ? plain_color(value) : value;
    }
#endif
}
