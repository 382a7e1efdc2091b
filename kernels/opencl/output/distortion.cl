// distortion (h, w): depth distortion of 2DGS, sum over pairs of w_i w_j (m_i - m_j)^2 with m the depth-buffer value for planes at
// 0.2 and 100 m: m = constant - INVERSE_DEPTH / z. Depths below 0.2 m are clamped: 1 / z is unbounded, and one edge-on disk
// would dominate the loss. Computed as W sum w m^2 - (sum w m)^2, which does not depend on the origin of m. The first
// fragment is the origin, so that little cancels.
//@ blend_types
#define INVERSE_DEPTH BLEND_REAL(0.2004008016032064)  // 0.2 * 100 / (100 - 0.2)
#define SPREAD_NEAR BLEND_REAL(0.2)
//@ state
    vfloat spread_first, spread_weight, spread_sum, spread_squares;
//@ start
    pixel->spread_first = 0.0f;
    pixel->spread_weight = 0.0f;
    pixel->spread_sum = 0.0f;
    pixel->spread_squares = 0.0f;
//@ composite
    vint spreads = VMASK(weight > 0.0f) & VMASK(attributes->z > 0.0f);
    vfloat spread_share = VSELECT((vfloat)0.0f, weight, spreads), inverse = INVERSE_DEPTH / max(attributes->z, (vfloat)SPREAD_NEAR);
    pixel->spread_first = VSELECT(pixel->spread_first, inverse, spreads & VMASK(pixel->spread_weight == 0.0f));
    vfloat nearer = inverse - pixel->spread_first;
    pixel->spread_weight += spread_share;
    pixel->spread_sum = FMA(spread_share, nearer, pixel->spread_sum);
    pixel->spread_squares = FMA(spread_share * nearer, nearer, pixel->spread_squares);
//@ store
        BLOCK_STORE(pixel->spread_first, distortion_raw + at, stride);
        BLOCK_STORE(pixel->spread_weight, distortion_raw + channel_stride + at, stride);
        BLOCK_STORE(pixel->spread_sum, distortion_raw + 2 * (size_t)channel_stride + at, stride);
        BLOCK_STORE(pixel->spread_squares, distortion_raw + 3 * (size_t)channel_stride + at, stride);
//@ resolve_start
    float distortion = 0;
//@ resolve_sample
            float spread_sum = distortion_raw[at + 2 * (size_t)channel_stride];
            distortion += distortion_raw[at + channel_stride] * distortion_raw[at + 3 * (size_t)channel_stride] - spread_sum * spread_sum;
//@ resolve_end
    distortion_out[out] = mean * distortion;
