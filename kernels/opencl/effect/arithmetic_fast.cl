// Fast exponential and logarithm of sums and products that every device rounds alike: bit-identical wherever FMA is one operation,
// with error bounds for all devices. Maximum errors over all arguments (tools/fast_bounds.py), in ulp, with FMA / without: exp
// 1.98 / 2.26 on -87 to 0, log 0.89 / 1.07 on 2^-24 to 1; OpenCL guarantees 3 for its own.
// Division has no replacement: CPUs have an instruction, and OpenCL guarantees 2.5 ulp on GPUs.
//@ arithmetic
// e^x for x <= 0, as 2^k e^r with |r| <= ln(2) / 2; e^r by the minimax polynomial of degree 5 that is 1 at 0, with relative error
// 9.2e-8. Below -87 the result stays e^-87 = 1.6e-38, since the exponent bits would underflow.
static inline vfloat fast_exp(vfloat x) {
    const float rounder = 12582912.0f;                  // 1.5 * 2^23: the last bits of the sum are the integer
    x = fmax(x, (vfloat)-87.0f);
    vfloat sum = FMA(x, (vfloat)1.44269504f, (vfloat)rounder), k = sum - rounder;
    vfloat r = FMA(k, (vfloat)-0.693359375f, x);        // Cody-Waite reduction: the high part of ln 2 has 9 bits, so k times it is exact
    r = FMA(k, (vfloat)2.12194440e-4f, r);
    vfloat p = FMA((vfloat)8.29030946e-3f, r, (vfloat)4.18979935e-2f);
    p = FMA(p, r, (vfloat)1.66676372e-1f);
    p = FMA(p, r, (vfloat)4.99991477e-1f);
    p = FMA(p, r, (vfloat)9.99999702e-1f);
    p = FMA(p, r, (vfloat)1.0f);
    return VAS_FLOAT(VAS_INT(p) + (VAS_INT(sum) << 23));
}

// ln x as ln m + k ln 2 with m from sqrt(1/2) to sqrt(2); ln m by the polynomial of Cephes (logf.c).
static inline vfloat fast_log(vfloat x) {
    vint bits = VAS_INT(x) - 0x3F3504F3;                // minus the bits of sqrt(1/2)
    vfloat m = VAS_FLOAT((bits & 0x7FFFFF) + 0x3F3504F3) - 1.0f, m2 = m * m;
    vfloat p = FMA((vfloat)7.0376836292e-2f, m, (vfloat)-1.1514610310e-1f);
    p = FMA(p, m, (vfloat)1.1676998740e-1f);
    p = FMA(p, m, (vfloat)-1.2420140846e-1f);
    p = FMA(p, m, (vfloat)1.4249322787e-1f);
    p = FMA(p, m, (vfloat)-1.6668057665e-1f);
    p = FMA(p, m, (vfloat)2.0000714765e-1f);
    p = FMA(p, m, (vfloat)-2.4999993993e-1f);
    p = FMA(p, m, (vfloat)3.3333331174e-1f);
    p = FMA(m2, (vfloat)-0.5f, p * m * m2);
    return FMA(VFLOAT(bits >> 23), (vfloat)6.93147181e-1f, m + p);
}

#define EXP fast_exp
#define LOG fast_log
