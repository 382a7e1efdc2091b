// Activation functions of the trained parameters.

#define SH_C0 0.28209479177387814f

static inline float4 unit(float4 q) { return q / sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w); }

// On CPUs the function of 16 values (adam.cl), whose last place may differ: all kernels then compute bit-identical parameters.
#if LANES == 1
#define EXP(x) exp(x)
#else
#define EXP(x) (exp((float16)(x)).s0)
#endif
static inline float sigmoid(float x) { return 1.0f / (1.0f + EXP(-x)); }

// RGB colour of an SH coefficient of degree 0.
static inline float plain_color(float value) { return fmax(SH_C0 * value + 0.5f, 0.0f); }
