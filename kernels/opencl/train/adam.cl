// Adam on the parameters before activation. NumPy reference with formulas: fidsplat/train/optimiser.py.

// Step of one value; m and v are Adam's first and second moment.
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

#if LANES > 1
// On CPUs: a vector of 16 values of any splats.
static inline float16 adam_16(
    float16 value, global float *m, global float *v, float16 gradient, float beta1, float beta2, float rest1, float rest2, float16 size,
    float root, float epsilon
) {
    float16 first = beta1 * vload16(0, m) + rest1 * gradient, second = beta2 * vload16(0, v) + rest2 * gradient * gradient;
    vstore16(first, 0, m);
    vstore16(second, 0, v);
    return value - size * first / (sqrt(second) / root + epsilon);
}

// New values of 16 elements from `k` on.
#define ADAM_16(name, k, gradient, size) \
    adam_16(vload16(0, name + (k)), first_##name + (k), second_##name + (k), gradient, beta1, beta2, rest1, rest2, size, root, epsilon)

// Sums of each four elements, in all four positions.
static inline float16 sums_of_4(float16 v) {
    return v.s000044448888cccc + v.s111155559999dddd + v.s22226666aaaaeeee + v.s33337777bbbbffff;
}

static inline float16 units(float16 q) { return q / sqrt(sums_of_4(q * q)); }
static inline float16 sigmoids(float16 x) { return 1.0f / (1.0f + exp(-x)); }
#endif
