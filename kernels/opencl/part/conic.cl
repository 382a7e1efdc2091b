// Culling by the ellipse of a disk: the columns in which some rows of samples overlap it. Fragments are where
// f = n_u^2 + n_v^2 - h D^2 <= 0, with h half the squared cut-off radius and n_u, n_v, D affine in the sample. Along a row, with
// a = (n_u, n_v, D) per x and b = (n_u, n_v, D) at x = 0,
//     f = <a, a> x^2 + 2 <a, b> x + <b, b>,   q = <a, b>^2 - <a, a> <b, b> = h |(a x b)_uD, (a x b)_vD|^2 - (a x b)_uv^2
// in the product <a, b> = a_u b_u + a_v b_v - h a_D b_D: the row overlaps the disk where q >= 0. a x b is affine in y, so no large
// terms cancel in q. The slack exceeds the rounding of f at any sample of the tile, here and in the per-pixel test.
//@ blocks_functions
#define BLOCKS_PAD 0.01f                // padding of distances to the low-pass disc, in samples
#define BLOCKS_SLACK 1e-6f              // relative to the terms of n_u, n_v and D: exceeds their rounding, here and in the per-pixel test
//@ blocks_touched
    // f >= 0 in all of a block for these lower bounds of |n_u| and |n_v| and this upper bound of D
    float conic_h = (float)half_r2;
//@@ footprint_conic
    const float half_x = 0.5f * (BLOCK_W - 1), half_y = 0.5f * (BLOCK_H - 1);
    float far_x = fmax(fabs(left - s->ax), fabs(left + TILE_W - s->ax)), far_y = fmax(fabs(top - s->ay), fabs(top + TILE_H - s->ay));
#define AROUND(n0, nx, ny) \
    (fabs(nx) * half_x + fabs(ny) * half_y + BLOCKS_SLACK * (fabs(n0) + fabs(nx) * far_x + fabs(ny) * far_y))
    float around_u = AROUND(s->nu0, s->nux, s->nuy), around_v = AROUND(s->nv0, s->nvx, s->nvy);
    float around_d = AROUND(s->d0, s->dx, s->dy);
    for (int first = 0; first < BLOCKS; first += LANES) {
        vfloat x = left - s->ax + half_x + VFLOAT(VINDEX % BLOCKS_X * BLOCK_W);
        vfloat y = top - s->ay + half_y + VFLOAT((first + VINDEX) / BLOCKS_X * BLOCK_H);
        vfloat u = fmax(fabs(FMA((vfloat)s->nuy, y, FMA((vfloat)s->nux, x, (vfloat)s->nu0))) - around_u, (vfloat)0.0f);
        vfloat v = fmax(fabs(FMA((vfloat)s->nvy, y, FMA((vfloat)s->nvx, x, (vfloat)s->nv0))) - around_v, (vfloat)0.0f);
        vfloat d = FMA((vfloat)s->dy, y, FMA((vfloat)s->dx, x, (vfloat)s->d0)) + around_d;
        vint outside = VMASK(FMA(u, u, v * v) > conic_h * (1.0f + BLOCKS_SLACK) * (d * d)) | VMASK(d < 0.0f);
//@@ blocks_lowpass
//@@ blocks_nearest
//@@ blocks_nearest_stored
        touched &= ~(VBITS(outside) << first);
    }
//@ cells_functions
static inline Conic conic_of(local const Splat *s, float h, float far_x, float far_y) {
    float u0 = s->nu0, ux = s->nux, uy = s->nuy, v0 = s->nv0, vx = s->nvx, vy = s->nvy, d0 = s->d0, dx = s->dx, dy = s->dy;
    float u = fabs(u0) + fabs(ux) * far_x + fabs(uy) * far_y, v = fabs(v0) + fabs(vx) * far_x + fabs(vy) * far_y;
    float d = fabs(d0) + fabs(dx) * far_x + fabs(dy) * far_y;
    float steep = ux * ux + vx * vx, bent = h * dx * dx, aa = steep - bent, inverse = FAST_RECIPROCAL(aa);
    float ud = ux * d0 - dx * u0, vd = vx * d0 - dx * v0, uv = ux * v0 - vx * u0;               // components of a x b: at y = 0,
    float ud_y = ux * dy - dx * uy, vd_y = vx * dy - dx * vy, uv_y = ux * vy - vx * uy;         // and their change per y
    // q = q0 + 2 q1 y - q2 y^2
    float q0 = h * (ud * ud + vd * vd) - uv * uv + CONIC_SLACK * (u * u + v * v + h * d * d) * aa;
    float q1 = h * (ud * ud_y + vd * vd_y) - uv * uv_y, grows = h * (ud_y * ud_y + vd_y * vd_y), q2 = uv_y * uv_y - grows;
    float shrinks = FAST_RECIPROCAL(q2);
    Conic c;
    c.valid = steep > 1e-12f && bent <= 0.5f * steep && uv_y * uv_y > 1e-12f * steep && grows <= 0.5f * uv_y * uv_y;
    c.middle = (h * dx * d0 - ux * u0 - vx * v0) * inverse;
    c.slope = (h * dx * dy - ux * uy - vx * vy) * inverse;
    c.y = q1 * shrinks;
    float square_height = fmax(q0 * shrinks + c.y * c.y, 0.0f);
    c.bend = q2 * inverse * inverse;
    c.square = square_height * c.bend;
    c.pad = CELLS_PAD + 1e-4f * far_x;
    c.half_height = FAST_SQRT(square_height) + CELLS_PAD + 1e-4f * far_y;
    c.tip = c.slope * square_height * FAST_RECIPROCAL(FAST_SQRT(c.slope * c.slope * square_height + c.square + 1e-12f));
    return c;
}
//@ cells_start
    float conic_h = (float)half_r2;
//@@ footprint_conic
    const Conic conic = conic_of(s, conic_h, fmax(fabs(shift), fabs(shift - (float)TILE_W)),
                                 fmax(fabs((float)top - (float)s->ay), fabs((float)(top + TILE_H) - (float)s->ay)));
