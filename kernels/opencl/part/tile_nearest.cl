// Minimum depth of a splat's fragments in a tile, for GPUs.
//@ intersect_functions
#define BLOCKS_SLACK 1e-6f              // above the rounding error, relative to the terms of the affine forms
static inline float tile_nearest(const Splat splat, int left, int top) {
    const Splat *s = &splat;
    const blend_real half_r2 = 1.0f;                  // hooks change it for 3D Gaussians only
    float conic_h = (float)half_r2;
//@@ footprint_conic
    const vfloat half_x = 0.5f * (TILE_W - 1), half_y = 0.5f * (TILE_H - 1), x = left + half_x - s->ax, y = top + half_y - s->ay;
    const vfloat around_d = fabs(s->dx) * half_x + fabs(s->dy) * half_y
        + BLOCKS_SLACK * (fabs(s->d0) + fabs(s->dx) * (fabs(x) + TILE_W) + fabs(s->dy) * (fabs(y) + TILE_H));
    const vfloat d = FMA(s->dy, y, FMA(s->dx, x, s->d0)) + around_d;        // at most, in the tile
    vfloat min_depth = s->z_center - s->z_reach;
//@@ camera_blocks_nearest
//@@ lowpass_blocks_nearest
    return convert_float_rtn(min_depth);
}
