// Results of the device's math functions in the types of the stages (vectors of LANES, `real`), which the host compares with exact
// values. Compiled after prelude.cl and math.cl with the functions of effect/arithmetic_fast.cl.

// Index space: one work-item per LANES values.
// Reads:  exponents, shares, above, below (each n; n a multiple of LANES). Writes: out, n floats of each:
//         exp, log, above / below, sqrt of below, fma, fast_exp, fast_log, RECIPROCAL of below.
kernel void arithmetic_float(uint n, global const float *restrict exponents, global const float *restrict shares,
                             global const float *restrict above, global const float *restrict below,
                             global float *restrict out) {
    uint at = get_global_id(0) * LANES;
    if (at >= n) return;
    vfloat a = VLOAD(above + at), b = VLOAD(below + at);
    VSTORE(exp(VLOAD(exponents + at)), out + at);
    VSTORE(log(VLOAD(shares + at)), out + n + at);
    VSTORE(a / b, out + 2 * (size_t)n + at);
    VSTORE(sqrt(b), out + 3 * (size_t)n + at);
    VSTORE(fma(a, b, a), out + 4 * (size_t)n + at);
    VSTORE(fast_exp(VLOAD(exponents + at)), out + 5 * (size_t)n + at);
    VSTORE(fast_log(VLOAD(shares + at)), out + 6 * (size_t)n + at);
    VSTORE(RECIPROCAL(b), out + 7 * (size_t)n + at);
}

// Index space: one work-item per value.
// Reads:  above, below (n). Writes: out, n of each: above / below, sqrt of below, ln of below.
kernel void arithmetic_real(uint n, global const real *restrict above, global const real *restrict below,
                            global real *restrict out) {
    uint at = get_global_id(0);
    if (at >= n) return;
    out[at] = above[at] / below[at];
    out[n + at] = sqrt(below[at]);
    out[2 * (size_t)n + at] = ln(below[at]);
}

// Index space: one work-item. Reads: in, (smallest normal float, 0.5). Writes: out: their product, and that times 2.
kernel void arithmetic_denormal(global const float *restrict in, global float *restrict out) {
    out[0] = in[0] * in[1];
    out[1] = out[0] * 2.0f;
}
