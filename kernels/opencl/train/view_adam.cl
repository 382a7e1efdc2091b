// Adam for poses, intrinsics and exposures of training views. NumPy version: `_Adam` in fidsplat/train/view_refinement.py.

// Step of 2 * `half_size` parameters: rotation and translation, for example. The second moment is averaged over each half. moments: the first moments,
// then the second ones. rate: the learning rate with both bias corrections.
static inline void view_adam(
    const real *gradient, uint half_size, global real *moments, real beta1, real beta2, real rate, real *change
) {
    global real *first = moments, *second = moments + 2 * half_size;
    for (uint start = 0; start < 2 * half_size; start += half_size) {
        real square = 0;
        for (uint k = start; k < start + half_size; k++) {
            first[k] += (1 - beta1) * (gradient[k] - first[k]);
            second[k] += (1 - beta2) * (gradient[k] * gradient[k] - second[k]);
            square += second[k];
        }
        real divisor = sqrt(square / half_size) + REAL(1e-12);
        for (uint k = start; k < start + half_size; k++) change[k] = -rate * first[k] / divisor;
    }
}
