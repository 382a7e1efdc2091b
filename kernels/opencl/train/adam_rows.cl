// Adam for CPUs (see adam.cl): the same steps, of 16 numbers side by side, whichever splat they belong to.

static inline float16 adam_16(
    float16 value, global float *m, global float *v, float16 gradient, float beta1, float beta2, float rest1, float rest2, float16 size,
    float root, float epsilon
) {
    float16 first = beta1 * vload16(0, m) + rest1 * gradient, second = beta2 * vload16(0, v) + rest2 * gradient * gradient;
    vstore16(first, 0, m);
    vstore16(second, 0, v);
    return value - size * first / (sqrt(second) / root + epsilon);
}

// Of 16 numbers from `k` on: their new values.
#define ADAM_16(name, k, gradient, size) \
    adam_16(vload16(0, name + (k)), first_##name + (k), second_##name + (k), gradient, beta1, beta2, rest1, rest2, size, root, epsilon)

// Of each four numbers the sum, in all four places.
static inline float16 sums_of_4(float16 v) {
    return v.s000044448888cccc + v.s111155559999dddd + v.s22226666aaaaeeee + v.s33337777bbbbffff;
}

static inline float16 units(float16 q) { return q / sqrt(sums_of_4(q * q)); }
static inline float16 sigmoids(float16 x) { return 1.0f / (1.0f + exp(-x)); }

// Index space: one work-item per 16 splats; a rest of them is left. Reads, changes and writes as adam_shapes, where no splat rests.
kernel void adam_shapes_16(
//@@ arguments adam_shapes
) {
    size_t group = get_global_id(0);
    if (16 * (group + 1) > count) return;
    for (size_t k = 48 * group; k < 48 * (group + 1); k += 16)
        vstore16(ADAM_16(means, k, vload16(0, by_means + k), (float16)size_means), 0, means + k);
    for (size_t k = 32 * group; k < 32 * (group + 1); k += 16) {
        float16 gradient = (vload16(0, by_scales + k) + scale_penalty) * vload16(0, drawn_scales + k);
        float16 value = ADAM_16(log_scales, k, gradient, (float16)size_scales);
        vstore16(value, 0, log_scales + k);
        vstore16(exp(value), 0, drawn_scales + k);
    }
    for (size_t k = 64 * group; k < 64 * (group + 1); k += 16) {
        float16 q = vload16(0, quats + k), by = vload16(0, by_quats + k);
        float16 length = sqrt(sums_of_4(q * q)), turn = q / length;
        by = (by - turn * sums_of_4(turn * by)) / length;
        q = ADAM_16(quats, k, by, (float16)size_quats);
        vstore16(q, 0, quats + k);
        vstore16(units(q), 0, drawn_quats + k);
    }
    size_t k = 16 * group;
    float16 opacity = vload16(0, drawn_opacities + k);
    float16 value = ADAM_16(logits, k, (vload16(0, by_opacities + k) + opacity_penalty) * opacity * (1.0f - opacity), (float16)size_logits);
    vstore16(value, 0, logits + k);
    vstore16(sigmoids(value), 0, drawn_opacities + k);
}

// Index space: one work-item per splat. Reads, changes and writes as adam_sh, of degree 1 and above.
kernel void adam_sh_rows(
//@@ arguments adam_sh
) {
    size_t i = get_global_id(0);
    if (i >= count || rests(i, drawn, sparse, by_means, by_opacities, by_sh)) return;
    size_t row = i * 3 * all, shown = i * 3 * drawn;
    uint k = 0;
    for (; k + 16 <= 3 * drawn; k += 16) {
        float16 size = size_rest;
        if (k == 0) size.s012 = size_sh;
        float16 value = ADAM_16(sh, row + k, vload16(0, by_sh + shown + k), size);
        vstore16(value, 0, sh + row + k);
        if (drawn_sh != sh) vstore16(value, 0, drawn_sh + shown + k);
    }
    for (; k < 3 * drawn; k++) drawn_sh[shown + k] = ADAM(sh, row + k, by_sh[shown + k], k < 3 ? size_sh : size_rest);
}
