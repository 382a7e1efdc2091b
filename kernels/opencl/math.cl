// Vectors of LANES pixels, and functions with different names for vectors and scalars. `blend_real` is the scalar type of fragments: the host
// prints float, or double for the effect blend_double (one lane). BLEND_REAL(1.5) is a constant of that type.

#define GLUE_(a, b) a##b
#define GLUE(a, b) GLUE_(a, b)

#if LANES == 1
typedef blend_real vfloat;
typedef int vint;
#define VSELECT(no, yes, mask) ((mask) ? (yes) : (no))
#define VANY(mask) (mask)
#define VLOAD(p) (*(p))
#define VSTORE(v, p) (*(p) = (v))
#define VMASK(condition) (-(condition))
#define VAS_INT(x) as_int(x)
#define VAS_FLOAT(x) as_float(x)
#define VFLOAT(i) ((vfloat)(i))
#define VMIN(a, b) fmin(a, b)
#define VMAX(a, b) fmax(a, b)
#define VLANE 0.0f
#define BLOCK_W 1
#define BLOCK_LOAD(p, stride) (*(p))
#define BLOCK_STORE(v, p, stride) (*(p) = (v))
#else
typedef GLUE(float, LANES) vfloat;
typedef GLUE(int, LANES) vint;
#define VSELECT(no, yes, mask) select(no, yes, mask)
// VBITS: one bit per set lane, by one instruction on x86. VANY: true if any lane is set; Clang compiles `any` to a branch per
// lane, and this reduction to one test.
#if defined(__has_builtin)
#if LANES == 16 && defined(__AVX512DQ__) && __has_builtin(__builtin_ia32_cvtd2mask512)
#define VBITS(mask) ((uint)(ushort)__builtin_ia32_cvtd2mask512((__attribute__((__vector_size__(64))) int)(mask)))
#elif LANES == 8 && defined(__AVX__) && __has_builtin(__builtin_ia32_movmskps256)
#define VBITS(mask) ((uint)__builtin_ia32_movmskps256(as_float8(mask)))
#elif LANES == 4 && defined(__SSE__) && __has_builtin(__builtin_ia32_movmskps)
#define VBITS(mask) ((uint)__builtin_ia32_movmskps(as_float4(mask)))
#elif __has_builtin(__builtin_reduce_or)
#define VANY(mask) (__builtin_reduce_or(mask) != 0)
#define VBITS(mask) ((uint)__builtin_reduce_or((mask) & (vint)1 << VINDEX))
#else
#define VANY(mask) any(mask)
#endif
#else
#define VANY(mask) any(mask)
#endif
#ifndef VANY
#define VANY(mask) (VBITS(mask) != 0)
#endif
#ifndef VBITS
static inline uint lanes_set(vint mask) {
    uint bits = 0;
    for (int lane = 0; lane < LANES; lane++) bits |= (uint)((int *)&mask)[lane] & 1u << lane;
    return bits;
}
#define VBITS(mask) lanes_set(mask)
#endif
// fmin and fmax for a `b` that is not NaN: one instruction each instead of four.
static inline vfloat VMIN(vfloat a, vfloat b) { return VSELECT(b, a, a < b); }
static inline vfloat VMAX(vfloat a, vfloat b) { return VSELECT(b, a, a > b); }
#define VLOAD(p) GLUE(vload, LANES)(0, p)
#define VSTORE(v, p) GLUE(vstore, LANES)(v, 0, p)
#define VMASK(condition) (condition)
#define VAS_INT(x) GLUE(as_int, LANES)(x)
#define VAS_FLOAT(x) GLUE(as_float, LANES)(x)
#define VFLOAT(i) GLUE(convert_float, LANES)(i)
// VLANE, VINDEX: lane numbers. Lanes are the pixels of a block that is BLOCK_W wide, row by row; its rows are `stride` apart in
// memory.
#if LANES == 16
#define VLANE ((vfloat)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#define VINDEX ((vint)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#define BLOCK_W 4
#define BLOCK_X ((vfloat)(0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3))
#define BLOCK_Y ((vfloat)(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3))
#define BLOCK_LOAD(p, stride) \
    ((vfloat)(vload4(0, p), vload4(0, (p) + (stride)), vload4(0, (p) + 2 * (stride)), vload4(0, (p) + 3 * (stride))))
#define BLOCK_STORE(v, p, stride) \
    vstore4((v).s0123, 0, p), vstore4((v).s4567, 0, (p) + (stride)), vstore4((v).s89ab, 0, (p) + 2 * (stride)), \
        vstore4((v).scdef, 0, (p) + 3 * (stride))
#elif LANES == 8
#define VLANE ((vfloat)(0, 1, 2, 3, 4, 5, 6, 7))
#define VINDEX ((vint)(0, 1, 2, 3, 4, 5, 6, 7))
#define BLOCK_W 4
#define BLOCK_X ((vfloat)(0, 1, 2, 3, 0, 1, 2, 3))
#define BLOCK_Y ((vfloat)(0, 0, 0, 0, 1, 1, 1, 1))
#define BLOCK_LOAD(p, stride) ((vfloat)(vload4(0, p), vload4(0, (p) + (stride))))
#define BLOCK_STORE(v, p, stride) vstore4((v).s0123, 0, p), vstore4((v).s4567, 0, (p) + (stride))
#elif LANES == 4
#define VLANE ((vfloat)(0, 1, 2, 3))
#define VINDEX ((vint)(0, 1, 2, 3))
#define BLOCK_W 2
#define BLOCK_X ((vfloat)(0, 1, 0, 1))
#define BLOCK_Y ((vfloat)(0, 0, 1, 1))
#define BLOCK_LOAD(p, stride) ((vfloat)(vload2(0, p), vload2(0, (p) + (stride))))
#define BLOCK_STORE(v, p, stride) vstore2((v).s01, 0, p), vstore2((v).s23, 0, (p) + (stride))
#endif
#endif

// Fused multiply-add where the device has it in hardware; elsewhere two roundings.
#if FAST_FMA
#define FMA(a, b, c) fma(a, b, c)
#else
#define FMA(a, b, c) ((a) * (b) + (c))
#endif
//@@ dialect
// 1 / x, correctly rounded where x and the result are normal numbers.
#ifndef RECIPROCAL
#define RECIPROCAL(x) (1.0f / (x))
#endif
// Reserves `count` entries for each work-item of a group. Returns the first; *length grows by the sum.
#ifndef RESERVE
#define RESERVE(length, count) atomic_add(length, count)
#endif
// Increments a counter and returns its previous value. SHARES: whether neighbouring work-items may increment the same counter, so that
// one atomic for all of them is faster.
#ifndef INCREMENT
#define SHARES(index) false
#define INCREMENT(counters, index, shared) atomic_inc((counters) + (index))
#endif
// Within 3 ulp: for culling only, not for values that affect the image.
#ifndef FAST_SQRT
#define FAST_SQRT(x) sqrt(x)
#define FAST_RECIPROCAL(x) (1.0f / (x))
#endif
//@@ arithmetic
// Result of EXP or LOG (effect/arithmetic_*.cl) for a single number, which a vector function computes.
#if LANES == 1
#define FIRST_LANE(v) (v)
#else
#define FIRST_LANE(v) ((v).s0)
#endif

// Natural logarithm in the projection of a splat, for normal x > 0; finite for every other x. Only sums and products, so that results are
// bit-identical on every device: range reduction and polynomial of fdlibm (e_log.c), below 1 ulp in double.
static inline real ln(real x) {
#if PROJECTION_FP64
    const long root_half = 0x3FE6A09E667F3BCDL;         // bits of sqrt(1/2)
    long bits = as_long(x) - root_half;
    real k = (real)(bits >> 52), f = as_double((bits & 0xFFFFFFFFFFFFFL) + root_half) - 1;
#else
    const int root_half = 0x3F3504F3;
    int bits = as_int(x) - root_half;
    real k = (real)(bits >> 23), f = as_float((bits & 0x7FFFFF) + root_half) - 1;
#endif
    real s = f / (2 + f), z = s * s, w = z * z, half_square = REAL(0.5) * f * f;
    real even = w * (REAL(3.999999999940941908e-01) + w * (REAL(2.222219843214978396e-01) + w * REAL(1.531383769920937332e-01)));
    real odd = z * (REAL(6.666666666666735130e-01)
                    + w * (REAL(2.857142874366239149e-01) + w * (REAL(1.818357216161805012e-01) + w * REAL(1.479819860511658591e-01))));
    real r = even + odd;
    // ln 2 in two words
    return k * REAL(6.93147180369123816490e-01)
           - ((half_square - (s * (half_square + r) + k * REAL(1.90821492927058770002e-10))) - f);
}

typedef struct { real x, y, z; } real3_;

static inline real3_ cross3(real3_ a, real3_ b) {
    real3_ c = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    return c;
}

static inline real dot3(real3_ a, real3_ b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// Bits of a float in an order that unsigned comparison preserves, negative values included. No depth is -0, which would sort
// before +0: depth is a sum, and no term of the view is -0 (tests/unit/test_prepare.py).
static inline uint sortable(float x) {
    uint bits = as_uint(x);
    return (bits & 0x80000000u) ? ~bits : (bits | 0x80000000u);
}

// Depth of a key: the inverse of `sortable`.
static inline float key_depth(uint key) { return as_float((key & 0x80000000u) ? key & 0x7FFFFFFFu : ~key); }

// Ceil and floor as int, clamped to an image of `limit` pixels, since converting huge values is undefined. On CPUs without
// PoCL's `ceil` and `floor`, which take a dozen instructions each.
#if LANES > 1
static inline int pixel_above(float x, int limit) {
    float within = clamp(x, -1.0f, (float)limit + 1.0f);
    int whole = (int)within;
    return whole + (int)((float)whole < within);
}
static inline int pixel_below(float x, int limit) {
    float within = clamp(x, -1.0f, (float)limit + 1.0f);
    int whole = (int)within;
    return whole - (int)((float)whole > within);
}
#else
static inline int pixel_above(float x, int limit) { return (int)clamp(ceil(x), -1.0f, (float)limit + 1.0f); }
static inline int pixel_below(float x, int limit) { return (int)clamp(floor(x), -1.0f, (float)limit + 1.0f); }
#endif

// Prefetch hint for reads at unpredictable addresses, where the CPU compiler has one.
#if LANES > 1 && defined(__has_builtin)
#if __has_builtin(__builtin_prefetch)
#define PREFETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#endif
#endif
#ifndef PREFETCH
#define PREFETCH(p)
#endif
