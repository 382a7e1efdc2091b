// Variant of conic.cl where every splat is a disk that faces the camera (ellipsoids_only). Fragments are where n_u^2 + n_v^2 <= h, h
// half the squared cut-off radius, and n_u depends on columns only. With a = (n_u, n_v) per x and b = (n_u, n_v) at x = 0, the squared
// half chord of a row is (h - (a x b)^2 / <a, a>) / <a, a>, and a x b is affine in y.
//@ blocks_functions
#define BLOCKS_SLACK 1e-6f              // above the rounding error here and in the per-pixel test, relative to the terms of the affine forms
//@ blocks_touched
    // u and v are lower bounds of |n_u| and |n_v| over a block: no pixel of it is inside the ellipse if u^2 + v^2 > h
    const float half_x = 0.5f * (BLOCK_W - 1), half_y = 0.5f * (BLOCK_H - 1);
    float far_x = fmax(fabs(left - s->ax), fabs(left + TILE_W - s->ax)), far_y = fmax(fabs(top - s->ay), fabs(top + TILE_H - s->ay));
    float around_u = fabs(s->nux) * half_x + BLOCKS_SLACK * (fabs(s->nu0) + fabs(s->nux) * far_x);
    float around_v = fabs(s->nvx) * half_x + fabs(s->nvy) * half_y
                     + BLOCKS_SLACK * (fabs(s->nv0) + fabs(s->nvx) * far_x + fabs(s->nvy) * far_y);
    for (int first = 0; first < BLOCKS; first += LANES) {
        vfloat x = left - s->ax + half_x + VFLOAT(VINDEX % BLOCKS_X * BLOCK_W);
        vfloat y = top - s->ay + half_y + VFLOAT((first + VINDEX) / BLOCKS_X * BLOCK_H);
        vfloat u = fmax(fabs(FMA((vfloat)s->nux, x, (vfloat)s->nu0)) - around_u, (vfloat)0.0f);
        vfloat v = fmax(fabs(FMA((vfloat)s->nvy, y, FMA((vfloat)s->nvx, x, (vfloat)s->nv0))) - around_v, (vfloat)0.0f);
        touched &= ~(VBITS(VMASK(FMA(u, u, v * v) > (float)half_r2 * (1.0f + BLOCKS_SLACK))) << first);
    }
//@ cells_functions
static inline Conic conic_of(local const Splat *s, float h, float far_x, float far_y) {
    float u0 = s->nu0, ux = s->nux, v0 = s->nv0, vx = s->nvx, vy = s->nvy;
    float u = fabs(u0) + fabs(ux) * far_x, v = fabs(v0) + fabs(vx) * far_x + fabs(vy) * far_y;
    float steep = ux * ux + vx * vx, inverse = FAST_RECIPROCAL(steep), uv = ux * v0 - vx * u0, uv_y = ux * vy;    // a x b: at y = 0, per y
    float shrinks = FAST_RECIPROCAL(uv_y), grown = h + CONIC_SLACK * (u * u + v * v + h);
    float square_height = grown * steep * shrinks * shrinks;
    Conic c;
    c.valid = steep > 1e-12f && uv_y * uv_y > 1e-12f * steep;
    c.middle = -(ux * u0 + vx * v0) * inverse;
    c.slope = -vx * vy * inverse;
    c.y = -uv * shrinks;
    c.bend = uv_y * uv_y * inverse * inverse;
    c.square = grown * inverse;
    c.pad = CELLS_PAD + 1e-4f * far_x;
    c.half_height = FAST_SQRT(square_height) + CELLS_PAD + 1e-4f * far_y;
    c.tip = c.slope * square_height * FAST_RECIPROCAL(FAST_SQRT(c.slope * c.slope * square_height + c.square + 1e-12f));
    return c;
}
//@ cells_start
    const Conic conic = conic_of(s, (float)half_r2, fmax(fabs(shift), fabs(shift - (float)TILE_W)),
                                 fmax(fabs((float)top - (float)s->ay), fabs((float)(top + TILE_H) - (float)s->ay)));
