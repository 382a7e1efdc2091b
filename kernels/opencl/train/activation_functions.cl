// From a splat's values before their activations to what is drawn of it.

#define SH_C0 0.28209479177387814f

static inline float4 unit(float4 q) { return q / sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w); }

// On CPUs those of 16 numbers at once (adam.cl), which may differ from others in the last place: what is drawn has the same bits
// whoever makes it.
#if LANES == 1
#define EXP(x) exp(x)
#else
#define EXP(x) (exp((float16)(x)).s0)
#endif
static inline float sigmoid(float x) { return 1.0f / (1.0f + EXP(-x)); }

// A value of degree 0 as a plain colour.
static inline float plain_color(float value) { return fmax(SH_C0 * value + 0.5f, 0.0f); }
