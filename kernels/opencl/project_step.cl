// Adam step on the gradients of project_splat_backward.cl, which stay in local memory: in training it replaces project_backward.
// Index space: one work-item per splat, in groups of STEP_ITEMS.
// Reads:  view, splats, keys, windows, big_bounds, gradient_offsets, record_gradients. Updates: if `add_statistics`, the sums of screen-space gradients and
// the numbers of frames in whose frustum a splat was; if `update`, the parameters, Adam's moments, and the activated parameters.
// IS_RGB, SH_COEFFICIENTS: from effect/color_*_backward.cl.
#define STEP_ITEMS 64
#define VALUES (3 * SH_COEFFICIENTS)       // rendered colour values per splat
#if LANES > 1 && !IS_RGB
#define COEFFICIENTS_CAPACITY 16               // a full vector
#else
#define COEFFICIENTS_CAPACITY SH_COEFFICIENTS
#endif
// Whether the sphere of radius `reach` around a mean intersects the frustum.
static inline bool in_frustum(global const View *view, float3 mean, float reach) {
    float p[3];
    for (uint k = 0; k < 3; k++)
        p[k] = (float)view->rotation[3 * k] * mean.x + (float)view->rotation[3 * k + 1] * mean.y + (float)view->rotation[3 * k + 2] * mean.z
             + (float)view->translation[k];
    // pixels times depth, so that nothing is divided by a depth of 0
    float focal_x = (float)view->focal_x, focal_y = (float)view->focal_y;
    float u = focal_x * p[0] + (float)view->center_x * p[2], v = focal_y * p[1] + (float)view->center_y * p[2];
    return p[2] > (float)view->near && u + focal_x * reach > 0.0f && u - focal_x * reach < (float)view->width * p[2]
        && v + focal_y * reach > 0.0f && v - focal_y * reach < (float)view->height * p[2];
}

kernel __attribute__((reqd_work_group_size(STEP_ITEMS, 1, 1))) void project_step(
//@@ arguments project_step
) {
    local float grad_means[3 * STEP_ITEMS], grad_scales[AXES * STEP_ITEMS], grad_quats[4 * STEP_ITEMS], grad_opacities[STEP_ITEMS];
    local float grad_colors[3 * STEP_ITEMS], basis[COEFFICIENTS_CAPACITY * STEP_ITEMS];
    local uchar skipped[STEP_ITEMS];
//@@ step_local
    uint i = get_global_id(0), item = get_local_id(0), first = get_group_id(0) * STEP_ITEMS;
    if (i < count) {
        const SplatGradient splat_grad = splat_gradient(
            i, view, means, activated_quats, activated_scales, activated_opacities, sh, stored_coefficients, splats, keys, windows, big_capacity,
            big_bounds, width, height, gradient_offsets, record_gradients
#if AXES == 3
            , activated_thickness
#endif
        );
        if (add_statistics) {
            float reach = 3.0f * fmax(activated_scales[2 * i], activated_scales[2 * i + 1]);
#if AXES == 3
            reach = fmax(reach, 3.0f * activated_thickness[i]);
#endif
            gradient_sums[i] += splat_grad.grad2d;
            visible_counts[i] += in_frustum(view, vload3(i, means), reach);
        }
        for (int k = 0; k < 3; k++) grad_means[3 * item + k] = splat_grad.mean[k];
        for (int k = 0; k < 2; k++) grad_scales[AXES * item + k] = splat_grad.scale[k];
#if AXES == 3
        grad_scales[AXES * item + 2] = splat_grad.thickness;
#endif
        for (int k = 0; k < 4; k++) grad_quats[4 * item + k] = splat_grad.quat[k];
        grad_opacities[item] = splat_grad.opacity;
        for (int k = 0; k < 3; k++) grad_colors[3 * item + k] = splat_grad.color[k];
        for (int k = 0; k < SH_COEFFICIENTS; k++) basis[COEFFICIENTS_CAPACITY * item + k] = splat_grad.basis[k];
        // parameters without gradient keep their values and Adam's moments
        bool depends = splat_grad.opacity != 0.0f;
        for (int k = 0; k < 3; k++) depends |= splat_grad.mean[k] != 0.0f || splat_grad.basis[0] * splat_grad.color[k] != 0.0f;
        skipped[item] = sparse && !depends;
//@@ step_gradient
    }
    barrier(CLK_LOCAL_MEM_FENCE);
//@@ step_sums
    if (!update) return;

#if LANES > 1
    // complete groups of 16 splats: vectors, by the first work-item of each
    bool vectorized = !sparse && (i | 15) < count;
    if (vectorized && item % 16 == 0) {
        for (uint k = 3 * item, at = 3 * i; k < 3 * item + 48; k += 16, at += 16)
            vstore16(ADAM_16(means, at, vload16(0, grad_means + k), (float16)lr_means), 0, means + at);
#if AXES == 2
        for (uint k = 2 * item, at = 2 * i; k < 2 * item + 32; k += 16, at += 16) {
            float16 gradient = (vload16(0, grad_scales + k) + scale_penalty) * vload16(0, activated_scales + at);
            float16 value = ADAM_16(log_scales, at, gradient, (float16)lr_scales);
            vstore16(value, 0, log_scales + at);
            vstore16(exp(value), 0, activated_scales + at);
        }
#endif
        for (uint k = 4 * item, at = 4 * i; k < 4 * item + 64; k += 16, at += 16) {
            float16 q = vload16(0, quats + at), grad_q = vload16(0, grad_quats + k);
            float16 length = sqrt(sums_of_4(q * q)), unit_q = q / length;
            grad_q = (grad_q - unit_q * sums_of_4(unit_q * grad_q)) / length;
            q = ADAM_16(quats, at, grad_q, (float16)lr_quats);
            vstore16(q, 0, quats + at);
            vstore16(units(q), 0, activated_quats + at);
        }
        float16 opacity = vload16(0, activated_opacities + i);
        float16 gradient = (vload16(0, grad_opacities + item) + opacity_penalty) * opacity * (1.0f - opacity);
        float16 value = ADAM_16(logits, i, gradient, (float16)lr_logits);
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
            ADAM(log_scales, 3 * i + k, (grad_scales[3 * item + k] + scale_penalty) * *activated, lr_scales);
            *activated = EXP(log_scales[3 * i + k]);
        }
#endif
    if (i < count && !vectorized && !skipped[item]) {
        for (uint k = 0; k < 3; k++) ADAM(means, 3 * i + k, grad_means[3 * item + k], lr_means);
#if AXES == 2
        for (uint k = 0; k < 2; k++) {
            uint at = 2 * i + k;
            ADAM(log_scales, at, (grad_scales[2 * item + k] + scale_penalty) * activated_scales[at], lr_scales);
            activated_scales[at] = EXP(log_scales[at]);
        }
#endif
        float4 q = vload4(i, quats), grad_q = vload4(item, grad_quats);
        float length = sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
        float4 unit_q = q / length;
        grad_q = (grad_q - unit_q * (unit_q.x * grad_q.x + unit_q.y * grad_q.y + unit_q.z * grad_q.z + unit_q.w * grad_q.w)) / length;
        ADAM(quats, 4 * i, grad_q.x, lr_quats);
        ADAM(quats, 4 * i + 1, grad_q.y, lr_quats);
        ADAM(quats, 4 * i + 2, grad_q.z, lr_quats);
        ADAM(quats, 4 * i + 3, grad_q.w, lr_quats);
        vstore4(unit(vload4(i, quats)), i, activated_quats);
        float opacity = activated_opacities[i];
        ADAM(logits, i, (grad_opacities[item] + opacity_penalty) * opacity * (1.0f - opacity), lr_logits);
        activated_opacities[i] = sigmoid(logits[i]);
    }

    // the rendered colours are the SH parameters, unless some degrees are not rendered or degree 0 is rendered as plain colours
    const bool separate = IS_RGB || SH_COEFFICIENTS < stored_coefficients;
#if LANES > 1 && !IS_RGB
    if (i < count && !skipped[item]) {
        size_t row = i * (size_t)(3 * stored_coefficients), out = i * (size_t)VALUES;
        // value k belongs to coefficient k / 3 and channel k % 3; values after the last coefficient are unused
        float16 b = vload16(0, basis + COEFFICIENTS_CAPACITY * item), c = 0.0f;
        c.s012 = vload3(item, grad_colors);
        const float16 gradients[3] = {
            b.s0001112223334445 * c.s0120120120120120,
            b.s55666777888999aa * c.s1201201201201201,
            b.sabbbcccdddeeefff * c.s2012012012012012,
        };
        uint k = 0;
        for (; k + 16 <= VALUES; k += 16) {
            float16 lr = lr_rest;
            if (k == 0) lr.s012 = lr_sh;
            float16 value = ADAM_16(sh, row + k, gradients[k / 16], lr);
            vstore16(value, 0, sh + row + k);
            if (separate) vstore16(value, 0, activated_sh + out + k);
        }
        float last[16];
        vstore16(gradients[k / 16 % 3], 0, last);
        for (; k < VALUES; k++) {
            float value = ADAM(sh, row + k, last[k % 16], k < 3 ? lr_sh : lr_rest);
            if (separate) activated_sh[out + k] = value;
        }
    }
#else
    // the group's coefficients in memory order
    for (uint k = item; k < min(count - first, (uint)STEP_ITEMS) * VALUES; k += STEP_ITEMS) {
        uint which = k / VALUES, within = k % VALUES;
        if (skipped[which]) continue;
        size_t at = (first + which) * (size_t)(3 * stored_coefficients) + within;
        float gradient = basis[COEFFICIENTS_CAPACITY * which + within / 3] * grad_colors[3 * which + within % 3];
        if (IS_RGB) gradient = SH_C0 * sh[at] + 0.5f > 0.0f ? SH_C0 * gradient : 0.0f;
        float value = ADAM(sh, at, gradient, within < 3 ? lr_sh : lr_rest);
        if (separate) activated_sh[(size_t)first * VALUES + k] = IS_RGB ? plain_color(value) : value;
    }
#endif
}
