// distortion = W sum w m^2 - (sum w m)^2: dL / dw = g (sum w m^2 + W m^2 - 2 m sum w m), dL / dm = 2 g w (W m - sum w m).
//@ compose_types
#define INVERSE_DEPTH WIDE(0.2004008016032064)  // as in distortion.cl
#define SPREAD_NEAR WIDE(0.2)
//@ loss
    vfloat distortion, spread_first, spread_weight, spread_sum, spread_squares;
//@ loss_start
        loss->distortion = pixels_of(by_distortion, 1, 0, x, y, width, height);
        loss->spread_first = BLOCK_LOAD(distortion_raw + at, stride);
        loss->spread_weight = BLOCK_LOAD(distortion_raw + channel_stride + at, stride);
        loss->spread_sum = BLOCK_LOAD(distortion_raw + 2 * (size_t)channel_stride + at, stride);
        loss->spread_squares = BLOCK_LOAD(distortion_raw + 3 * (size_t)channel_stride + at, stride);
//@ worth
    vint spreads = VMASK(g->z > 0.0f);
    vfloat nearer = INVERSE_DEPTH / max(g->z, (vfloat)SPREAD_NEAR) - loss->spread_first;
    vfloat spread = FMA(FMA(loss->spread_weight, nearer, -2.0f * loss->spread_sum), nearer, loss->spread_squares);
    worth = FMA(loss->distortion, VSELECT((vfloat)0.0f, spread, spreads), worth);
//@ fragment_backward
    vfloat inverse_z = 1.0f / VSELECT((vfloat)INFINITY, g->z, VMASK(g->z > SPREAD_NEAR));
    vfloat outward = FMA(loss->spread_weight, FMA((vfloat)INVERSE_DEPTH, inverse_z, -loss->spread_first), -loss->spread_sum);
    by_d += add_depth(sums, s, g, -2.0f * INVERSE_DEPTH * weight * loss->distortion * outward * inverse_z * inverse_z, screen, x, y, &by_nu, &by_nv);
