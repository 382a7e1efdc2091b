// Pairs of halves in a register of NVIDIA's GPUs (effect/blend_half.cl).
//@ dialect
typedef uint half_pair;
static inline half_pair ptx_half_pair(float low, float high) {
    half_pair pair;
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(pair) : "f"(high), "f"(low));
    return pair;
}
static inline half_pair ptx_half_fma(half_pair a, half_pair b, half_pair c) {
    half_pair pair;
    asm("fma.rn.f16x2 %0, %1, %2, %3;" : "=r"(pair) : "r"(a), "r"(b), "r"(c));
    return pair;
}
static inline half_pair ptx_half_by_high(half_pair a, half_pair b) {
    half_pair pair;
    asm("{\n"
        ".reg .b16 low, high;\n"
        ".reg .b32 twice;\n"
        "mov.b32 {low, high}, %2;\n"
        "mov.b32 twice, {high, high};\n"
        "mul.rn.f16x2 %0, %1, twice;\n"
        "}" : "=r"(pair) : "r"(a), "r"(b));
    return pair;
}
static inline float ptx_half_low(half_pair pair) {
    float x;
    asm("{\n.reg .b16 low, high;\nmov.b32 {low, high}, %1;\ncvt.f32.f16 %0, low;\n}" : "=f"(x) : "r"(pair));
    return x;
}
static inline float ptx_half_high(half_pair pair) {
    float x;
    asm("{\n.reg .b16 low, high;\nmov.b32 {low, high}, %1;\ncvt.f32.f16 %0, high;\n}" : "=f"(x) : "r"(pair));
    return x;
}
#define HALF_PAIR(low, high) ptx_half_pair(low, high)
#define HALF_FMA(a, b, c) ptx_half_fma(a, b, c)
#define HALF_BY_HIGH(a, b) ptx_half_by_high(a, b)
#define HALF_LOW(pair) ptx_half_low(pair)
#define HALF_HIGH(pair) ptx_half_high(pair)
