// Gradient of W sum w m^2 - (sum w m)^2: dL / dw = g (sum w m^2 + W m^2 - 2 m sum w m), dL / dm = 2 g w (W m - sum w m).
//@ blend_types
#define INVERSE_DEPTH BLEND_REAL(0.2004008016032064)  // as in distortion.cl
#define SPREAD_NEAR BLEND_REAL(0.2)
//@ pixel_gradient
    vfloat distortion, spread_first, spread_weight, spread_sum, spread_squares;
//@ pixel_gradient_start
        gradient->distortion = pixels_of(grad_distortion, 1, 0, x, y, width, height);
        gradient->spread_first = BLOCK_LOAD(distortion_raw + at, stride);
        gradient->spread_weight = BLOCK_LOAD(distortion_raw + channel_stride + at, stride);
        gradient->spread_sum = BLOCK_LOAD(distortion_raw + 2 * (size_t)channel_stride + at, stride);
        gradient->spread_squares = BLOCK_LOAD(distortion_raw + 3 * (size_t)channel_stride + at, stride);
//@ grad_weight
    vint spreads = VMASK(g->z > 0.0f);
    vfloat nearer = INVERSE_DEPTH / max(g->z, (vfloat)SPREAD_NEAR) - gradient->spread_first;
    vfloat spread = FMA(FMA(gradient->spread_weight, nearer, -2.0f * gradient->spread_sum), nearer, gradient->spread_squares);
    grad_weight = FMA(gradient->distortion, VSELECT((vfloat)0.0f, spread, spreads), grad_weight);
//@ fragment_backward
    vfloat inverse_z = 1.0f / VSELECT((vfloat)INFINITY, g->z, VMASK(g->z > SPREAD_NEAR));
    vfloat outward = FMA(gradient->spread_weight, FMA((vfloat)INVERSE_DEPTH, inverse_z, -gradient->spread_first), -gradient->spread_sum);
    grad_d += add_depth(sums, s, g, -2.0f * INVERSE_DEPTH * weight * gradient->distortion * outward * inverse_z * inverse_z,
                      lowpass_half_rho, x, y, &grad_nu, &grad_nv);
