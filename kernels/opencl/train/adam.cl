// Adam on the splats' values before their activations, which it computes again: the derivatives by what is drawn come in, what is drawn
// next goes out. Its twin in NumPy, with the formulas: fidsplat/train/optimiser.py.

#define SH_C0 0.28209479177387814f

// One value's step; m and v are its running means.
static inline float adam(
    float value, global float *m, global float *v, float gradient, float beta1, float beta2, float rest1, float rest2, float size,
    float root, float epsilon
) {
    float first = beta1 * *m + rest1 * gradient, second = beta2 * *v + rest2 * gradient * gradient;
    *m = first;
    *v = second;
    return value - size * first / (sqrt(second) / root + epsilon);
}

#define ADAM(name, k, gradient, size) \
    (name[k] = adam(name[k], first_##name + (k), second_##name + (k), gradient, beta1, beta2, rest1, rest2, size, root, epsilon))

static inline float4 unit(float4 q) { return q / sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w); }

// On CPUs those of 16 numbers at once (adam_rows.cl), which may differ from others in the last place: what is drawn has the same bits
// whoever makes it.
#if LANES == 1
#define EXP(x) exp(x)
#else
#define EXP(x) (exp((float16)(x)).s0)
#endif
static inline float sigmoid(float x) { return 1.0f / (1.0f + EXP(-x)); }

// Index space: one work-item per splat. Reads: the values. Writes: unit quaternions, scales, opacities.
kernel void activate(
//@@ arguments activate
) {
    size_t i = get_global_id(0);
    if (i >= count) return;
    vstore4(unit(vload4(i, quats)), i, drawn_quats);
    for (size_t k = 2 * i; k < 2 * i + 2; k++) drawn_scales[k] = EXP(log_scales[k]);
    drawn_opacities[i] = sigmoid(logits[i]);
}

// Index space: one work-item per splat and drawn coefficient of a channel. Reads: sh, of `all` coefficients. Writes: the first
// `drawn` of them, side by side; of degree 0, where `plain`, the colours that they mean.
kernel void activate_sh(
//@@ arguments activate_sh
) {
    uint k = get_global_id(0);
    if (k >= count * 3 * drawn) return;
    float value = sh[k / (3 * drawn) * 3 * all + k % (3 * drawn)];
    drawn_sh[k] = plain ? fmax(SH_C0 * value + 0.5f, 0.0f) : value;
}

// Whether a splat stays as it is, its running means too: where `sparse`, one that the picture does not depend on.
static inline bool rests(
    uint i, uint drawn, int sparse, global const float *by_means, global const float *by_opacities, global const float *by_sh
) {
    if (!sparse || by_opacities[i] != 0.0f) return false;
    float3 mean = vload3(i, by_means), color = vload3(i * (size_t)drawn, by_sh);
    return !(any(mean != 0.0f) || any(color != 0.0f));
}

// Index space: one work-item per splat. Reads: the derivatives by means, scales, quaternions and opacities. Changes: the values and
// their running means. Writes: what is drawn.
kernel void adam_shapes(
//@@ arguments adam_shapes
) {
    size_t i = get_global_id(0);
    if (i >= count || rests(i, drawn, sparse, by_means, by_opacities, by_sh)) return;
    for (size_t k = 3 * i; k < 3 * i + 3; k++) ADAM(means, k, by_means[k], size_means);
    for (size_t k = 2 * i; k < 2 * i + 2; k++) {
        ADAM(log_scales, k, (by_scales[k] + scale_penalty) * drawn_scales[k], size_scales);
        drawn_scales[k] = EXP(log_scales[k]);
    }
    float4 q = vload4(i, quats), by = vload4(i, by_quats);
    float length = sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
    float4 turn = q / length;
    by = (by - turn * (turn.x * by.x + turn.y * by.y + turn.z * by.z + turn.w * by.w)) / length;
    ADAM(quats, 4 * i, by.x, size_quats);
    ADAM(quats, 4 * i + 1, by.y, size_quats);
    ADAM(quats, 4 * i + 2, by.z, size_quats);
    ADAM(quats, 4 * i + 3, by.w, size_quats);
    vstore4(unit(vload4(i, quats)), i, drawn_quats);
    float opacity = drawn_opacities[i];
    ADAM(logits, i, (by_opacities[i] + opacity_penalty) * opacity * (1.0f - opacity), size_logits);
    drawn_opacities[i] = sigmoid(logits[i]);
}

// Index space, reads and writes: as activate_sh, and the derivatives by what is drawn. Changes: sh and its running means.
kernel void adam_sh(
//@@ arguments adam_sh
) {
    uint k = get_global_id(0);
    if (k >= count * 3 * drawn) return;
    uint i = k / (3 * drawn), within = k % (3 * drawn), at = i * 3 * all + within;
    if (rests(i, drawn, sparse, by_means, by_opacities, by_sh)) return;
    float gradient = by_sh[k];
    if (plain) gradient = SH_C0 * sh[at] + 0.5f > 0.0f ? SH_C0 * gradient : 0.0f;
    float value = ADAM(sh, at, gradient, within < 3 ? size_sh : size_rest);
    drawn_sh[k] = plain ? fmax(SH_C0 * value + 0.5f, 0.0f) : value;
}

// Index space: one work-item per splat. Reads: means, scales, the derivatives by places on the screen. Changes: their sums, and how often
// a splat was seen: a sphere of three standard deviations around it reaches into the picture.
kernel void count_seen(
//@@ arguments count_seen
) {
    size_t i = get_global_id(0);
    if (i >= count) return;
    float3 p = vload3(i, means);
    float x = turn_00 * p.x + turn_01 * p.y + turn_02 * p.z + move_x;
    float y = turn_10 * p.x + turn_11 * p.y + turn_12 * p.z + move_y;
    float z = turn_20 * p.x + turn_21 * p.y + turn_22 * p.z + move_z;
    float reach = 3.0f * fmax(drawn_scales[2 * i], drawn_scales[2 * i + 1]);
    // of pixels times depth, so that nothing is divided by a depth of 0
    float u = focal_x * x + center_x * z, v = focal_y * y + center_y * z;
    bool inside = z > near && u + focal_x * reach > 0.0f && u - focal_x * reach < width * z && v + focal_y * reach > 0.0f
        && v - focal_y * reach < height * z;
    gradients[i] += screen[i];
    seen[i] += inside ? 1.0f : 0.0f;
}
