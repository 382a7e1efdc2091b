// Peak rates of copy, multiply-add, exp and division, timed by the host. Compiled after prelude.cl and math.cl; vectors of LANES,
// as in the blend stage.

// Independent chains per work-item, so that latency is hidden.
#define CHAINS 8

// Index space: one work-item per float4. Reads: in. Writes: out, the same.
kernel void roofline_copy(global const float4 *restrict in, global float4 *restrict out) {
    size_t at = get_global_id(0);
    out[at] = in[at];
}

// Three kernels that differ in one expression. Index space: any. Each work-item computes `rounds` results per chain and lane.
// Reads: nothing. Writes: out[LANES * items], so that the compiler removes nothing.
// `a` and `b` are arguments, since constants would be folded.
#define RATE(name, expression) \
    kernel void name(uint rounds, float a, float b, global float *restrict out) { \
        vfloat x[CHAINS]; \
        for (int k = 0; k < CHAINS; k++) x[k] = (vfloat)(0.5f + 0.01f * k) + VLANE * 0.001f; \
        for (uint round = 0; round < rounds; round++) \
            _Pragma("unroll") for (int k = 0; k < CHAINS; k++) x[k] = expression; \
        vfloat sum = x[0]; \
        for (int k = 1; k < CHAINS; k++) sum += x[k]; \
        VSTORE(sum, out + (size_t)get_global_id(0) * LANES); \
    }

RATE(roofline_fma, fma(x[k], (vfloat)a, (vfloat)b))
RATE(roofline_exp, exp((vfloat)a - x[k]))
RATE(roofline_division, (vfloat)a / x[k])
