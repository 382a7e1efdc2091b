// Adam on the parameters before activation. NumPy reference with formulas: fidsplat/train/optimiser.py.

// Step of one value; m and v are Adam's first and second moment.
static inline float adam(
    float value, global float *m, global float *v, float gradient, float lr, float beta1, float beta2, float one_minus_beta1,
    float one_minus_beta2, float sqrt_correction2, float epsilon
) {
    float first = beta1 * *m + one_minus_beta1 * gradient, second = beta2 * *v + one_minus_beta2 * gradient * gradient;
    *m = first;
    *v = second;
    return value - lr * first / (sqrt(second) / sqrt_correction2 + epsilon);
}

#define ADAM(name, k, gradient, lr) \
    (name[k] = adam(name[k], first_##name + (k), second_##name + (k), gradient, lr, beta1, beta2, one_minus_beta1, one_minus_beta2, \
                    sqrt_correction2, epsilon))

#if LANES > 1
// On CPUs: a vector of 16 values of any splats.
static inline float16 adam_16(
    float16 value, global float *m, global float *v, float16 gradient, float16 lr, float beta1, float beta2, float one_minus_beta1,
    float one_minus_beta2, float sqrt_correction2, float epsilon
) {
    float16 first = beta1 * vload16(0, m) + one_minus_beta1 * gradient;
    float16 second = beta2 * vload16(0, v) + one_minus_beta2 * gradient * gradient;
    vstore16(first, 0, m);
    vstore16(second, 0, v);
    return value - lr * first / (sqrt(second) / sqrt_correction2 + epsilon);
}

// New values of 16 elements from `k` on.
#define ADAM_16(name, k, gradient, lr) \
    adam_16(vload16(0, name + (k)), first_##name + (k), second_##name + (k), gradient, lr, beta1, beta2, one_minus_beta1, \
            one_minus_beta2, sqrt_correction2, epsilon)

// Sums of each four elements, in all four positions.
static inline float16 sums_of_4(float16 v) {
    return v.s000044448888cccc + v.s111155559999dddd + v.s22226666aaaaeeee + v.s33337777bbbbffff;
}

static inline float16 units(float16 q) { return q / sqrt(sums_of_4(q * q)); }
static inline float16 sigmoids(float16 x) { return 1.0f / (1.0f + exp(-x)); }
#endif
