// The hardware exponential of NVIDIA's GPUs instead of a polynomial: relative error at most 1e-6 for alphas above 1e-5; 0 below the smallest
// normal float. The hardware reciprocal, within 1 ulp, is used without a Newton step.
//@ arithmetic
static inline float ptx_exp(float x) {
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x * 1.44269504f));
    return y;
}
#undef EXP
#define EXP ptx_exp
#undef RECIPROCAL
#define RECIPROCAL(x) ptx_fast_reciprocal(x)
