// What the device can do at best: rates of copying, multiply-add, exp and division, for the host to time. Built with prelude.cl
// and math.cl in front; vectors of LANES, as the blend stage has them.

// Values that each work-item keeps going side by side, so that no result is waited for.
#define CHAINS 8

// Index space: one work-item per float4. Reads: in. Writes: out, the same.
kernel void roofline_copy(global const float4 *restrict in, global float4 *restrict out) {
    size_t at = get_global_id(0);
    out[at] = in[at];
}

// Three kernels that differ in one expression. Index space: any. `rounds` results per chain and lane of each work-item.
// Reads: nothing. Writes: out[LANES * items], so that nothing can be left out.
// `a` and `b` come from the host: what is constant would be worked out beforehand.
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
