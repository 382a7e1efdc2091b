// Instructions of NVIDIA's GPUs, by inline PTX.
//@ dialect
static inline float ptx_fast_sqrt(float x) {
    float y;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
static inline float ptx_fast_reciprocal(float x) {
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
#define FAST_SQRT(x) ptx_fast_sqrt(x)
#define FAST_RECIPROCAL(x) ptx_fast_reciprocal(x)

// The driver's division is not correctly rounded, and scales its argument to support subnormal numbers.
static inline float ptx_reciprocal(float x) {
    float y = ptx_fast_reciprocal(x);
    return fma(fma(-x, y, 1.0f), y, y);
}
#define RECIPROCAL(x) ptx_reciprocal(x)

// Transposes a matrix of 32 x 32 bits; each lane of a warp has a row.
static inline uint ptx_transpose_bits(uint bits) {
    uint lane = get_local_id(0) % 32, low = 0x0000FFFFu;
    for (uint step = 16; step != 0; step >>= 1, low ^= low << step) {
        uint other;
        asm volatile("shfl.sync.bfly.b32 %0, %1, %2, 31, 0xffffffff;" : "=r"(other) : "r"(bits), "r"(step));
        bits = lane & step ? (bits & ~low) | (other >> step & low) : (bits & low) | (other & low) << step;
    }
    return bits;
}
#define TRANSPOSE_BITS(bits) ptx_transpose_bits(bits)
#define WARP_BARRIER() asm volatile("bar.warp.sync 0xffffffff;" ::: "memory")

// Uses one atomic per warp, since atomics on one address are serialised.
static inline uint ptx_reserve(local uint *length, uint count) {
    uint lane = get_local_id(0) % 32, sum = count, first = 0;
    for (uint step = 1; step < 32; step *= 2) {
        uint before;
        asm volatile("shfl.sync.up.b32 %0, %1, %2, 0, 0xffffffff;" : "=r"(before) : "r"(sum), "r"(step));
        if (lane >= step) sum += before;
    }
    if (lane == 31) first = atomic_add(length, sum);
    asm volatile("shfl.sync.idx.b32 %0, %0, 31, 31, 0xffffffff;" : "+r"(first));
    return first + sum - count;
}
#define RESERVE(length, count) ptx_reserve(length, count)

// Active work-items of the warp with the same value, as bits.
static inline uint ptx_same(uint value, uint *active) {
    uint same;
    asm volatile("activemask.b32 %0;" : "=r"(*active));
    asm volatile("match.any.sync.b32 %0, %1, %2;" : "=r"(same) : "r"(value), "r"(*active));
    return same;
}
static inline bool ptx_shares(uint value) {
    uint active, same = ptx_same(value, &active), shared;
    asm volatile("{.reg .pred p; setp.ne.u32 p, %1, 0; vote.sync.ballot.b32 %0, p, %2;}"
                 : "=r"(shared) : "r"(same & (same - 1)), "r"(active));
    return shared != 0;
}
#define SHARES(value) ptx_shares(value)

static inline uint ptx_increment(global uint *counters, uint index) {
    uint active, same = ptx_same(index, &active), before, position = 0;
    asm("mov.u32 %0, %%lanemask_lt;" : "=r"(before));
    before &= same;
    if (before == 0) position = atomic_add(counters + index, popcount(same));
    asm volatile("shfl.sync.idx.b32 %0, %0, %1, 31, %2;" : "+r"(position) : "r"(31 - clz(same & -same)), "r"(same));
    return position + popcount(before);
}
#define INCREMENT(counters, index, shared) ((shared) ? ptx_increment(counters, index) : atomic_inc((counters) + (index)))
