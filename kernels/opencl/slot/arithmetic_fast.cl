// Shorter exponentials and logarithms, and on a GPU its own short functions. On CPUs, where `native_*` are the library's
// functions under another name, they are polynomials: 2^f for |f| <= 1/2 of degree 5, relative error 1.1e-7 before rounding
// (Lawson's algorithm), and ln m of Cephes; one instruction divides as fast as any substitute.
//@ arithmetic
#if LANES == 1
static inline vfloat fast_exp(vfloat x) { return native_exp(x); }
static inline vfloat fast_log(vfloat x) { return native_log(x); }
static inline vfloat fast_reciprocal(vfloat x) { return native_recip(x); }
#else
static inline vfloat fast_exp(vfloat x) {
    const vfloat log2_e = 1.44269504088896341f;
    const float rounder = 12582912.0f;       // 1.5 * 2^23: the sum's last bits are the whole number
    x = fmax(x, (vfloat)-87.0f);             // below, the exponent's bits would run over
    vfloat sum = FMA(x, log2_e, (vfloat)rounder);
    vfloat f = FMA(x, log2_e, rounder - sum);
    vfloat p = FMA((vfloat)1.32645783e-3f, f, (vfloat)9.67161916e-3f);
    p = FMA(p, f, (vfloat)5.55073507e-2f);
    p = FMA(p, f, (vfloat)2.40222409e-1f);
    p = FMA(p, f, (vfloat)6.93147004e-1f);
    p = FMA(p, f, (vfloat)1.0f);
    return GLUE(as_float, LANES)(GLUE(as_int, LANES)(p) + (GLUE(as_int, LANES)(sum) << 23));
}

static inline vfloat fast_log(vfloat x) {
    vint bits = GLUE(as_int, LANES)(x) - 0x3F3504F3;         // sqrt(1/2): m lies between it and sqrt(2)
    vfloat m = GLUE(as_float, LANES)((bits & 0x7FFFFF) + 0x3F3504F3) - 1.0f, m2 = m * m;
    vfloat p = FMA((vfloat)7.0376836292e-2f, m, (vfloat)-1.1514610310e-1f);
    p = FMA(p, m, (vfloat)1.1676998740e-1f);
    p = FMA(p, m, (vfloat)-1.2420140846e-1f);
    p = FMA(p, m, (vfloat)1.4249322787e-1f);
    p = FMA(p, m, (vfloat)-1.6668057665e-1f);
    p = FMA(p, m, (vfloat)2.0000714765e-1f);
    p = FMA(p, m, (vfloat)-2.4999993993e-1f);
    p = FMA(p, m, (vfloat)3.3333331174e-1f);
    p = FMA(m2, (vfloat)-0.5f, p * m * m2);
    return FMA(GLUE(convert_float, LANES)(bits >> 23), (vfloat)6.93147181e-1f, m + p);
}

static inline vfloat fast_reciprocal(vfloat x) { return 1.0f / x; }
#endif
//@ opacity
    return fmin(fast_exp(s->log_opacity - half_rho), (vfloat)ceiling);
//@ reciprocal
    vfloat inverse_d = fast_reciprocal(c.d);
//@ layer_tau
    vfloat tau = -fast_log(fmax(1.0f - opacity, (vfloat)0x1p-24f));
