// Screen-space low-pass of 2DGS (Huang et al. 2024, eq. 11, sigma = sqrt(1/2) px): rho = min(rho_3d, 2 d^2) with d the distance in
// pixels from the projected centre. It adds a disc around the centre (disc_*), rendered if the centre is beyond the near plane,
// independently of the ray-plane intersection.
//@ bounds_make
        bounds.px = (float)center_x;
        bounds.py = (float)center_y;
        bounds.pr = pz >= near ? sqrt(half_r2 / (float)view->sample_area) * (1.0f + BOUNDS_PAD_RELATIVE) + BOUNDS_PAD : -1.0f;
//@@ footprint_lowpass_bounds
//@ bounds_span
    float lowpass_low = fmax(y0 - b->py, -b->pr), lowpass_high = fmin(y1 - b->py, b->pr);
    if (lowpass_low <= lowpass_high) {
        float at = clamp(0.0f, lowpass_low, lowpass_high);
        float half_chord = FAST_SQRT(fmax(b->pr * b->pr - at * at, 0.0f)) + BOUNDS_PAD;
        *x0 = fmin(*x0, b->px - half_chord);
        *x1 = fmax(*x1, b->px + half_chord);
    }
//@ bounds_rows
    if (b->pr >= 0.0f) {
        low = fmin(low, b->py - b->pr);
        high = fmax(high, b->py + b->pr);
    }
//@ project
        record.lowpass_x = pz >= near ? (blend_real)(center_x - anchor_x) : 1e18f;
        record.lowpass_y = pz >= near ? (blend_real)(center_y - anchor_y) : 1e18f;
//@@ camera_lowpass
//@@ footprint_lowpass
//@ cells_start
    const float lowpass_square = s->lowpass_x < 1e17f ? (float)(half_r2 / sample_area) * (1.0f + 1e-4f) : -1.0f;   // -1: no disc
//@ cells_lowpass
            float lowpass_y = clamp((float)s->lowpass_y, y0, y1) - (float)s->lowpass_y, lowpass_rest = lowpass_square - lowpass_y * lowpass_y;
            if (lowpass_rest >= 0.0f) {
                float half_chord = FAST_SQRT(lowpass_rest) + CELLS_PAD;
                low = fmin(low, (float)s->lowpass_x - half_chord);
                high = fmax(high, (float)s->lowpass_x + half_chord);
            }
//@ blocks_lowpass
        if (HAS_LOWPASS(s)) {
            vfloat lowpass_x = fmax(fabs(x - s->lowpass_x) - half_x - BLOCKS_PAD, (vfloat)0.0f);
            vfloat lowpass_y = fmax(fabs(y - s->lowpass_y) - half_y - BLOCKS_PAD, (vfloat)0.0f);
            outside &= VMASK(FMA(lowpass_x, lowpass_x, lowpass_y * lowpass_y) * sample_area > half_r2);
        }
//@ intersect_functions
#define HAS_LOWPASS(s) ((s)->lowpass_x < 1e17f)       // lowpass_x is huge without a low-pass disc, NaN where the lens has no image of the centre
//@ fragment_mask
// Vectors of pixels skip splats without a disc; for single pixels the test costs as much as it saves.
#if LANES > 1
#define SKIPS_LOWPASS(s) (!HAS_LOWPASS(s))
#else
#define SKIPS_LOWPASS(s) false
#endif

static inline vint fragment_mask(const Splat *s, Intersection c, vfloat x, vfloat y, blend_real half_r2, blend_real sample_area,
                                 vfloat *lowpass_half_rho) {
    *lowpass_half_rho = 0.0f;
    if (SKIPS_LOWPASS(s)) return c.inside;
    vfloat ex = x - s->lowpass_x;
    vfloat ey = y - s->lowpass_y;
    *lowpass_half_rho = FMA(ex, ex, ey * ey) * sample_area;
    return c.inside | VMASK(*lowpass_half_rho <= half_r2);
}
//@ fragment_half_rho
static inline vfloat fragment_half_rho(const Splat *s, Intersection c, vfloat inverse_d, vfloat lowpass_half_rho) {
    vfloat half_rho = HALF_RHO(c, inverse_d);
    return SKIPS_LOWPASS(s) ? half_rho : VSELECT(lowpass_half_rho, VMIN(half_rho, lowpass_half_rho), c.inside);
}
//@ lowpass_intersection
    vfloat lowpass_half_rho;              // rho / 2 of the low-pass disc
//@ lowpass_mask
            c.lowpass_half_rho = lowpass_half_rho;
//@ lowpass_attribute_depth
    // In the disc, the ray-plane intersection may be far outside of the splat. Beyond the circle rho = 2 ln 255, inside of which a splat
    // has at least 1/255 of its opacity, depths are reflected at the circle: the difference from the centre's depth is multiplied by
    // 2 ln 255 / rho and tends to 0 at the plane's horizon. Where the disc's rho is larger it defines the circle, which makes depth
    // continuous at the disc's border (docs/correctness.md).
    if (HAS_LOWPASS(s)) {
        vfloat circle = VMAX(c.lowpass_half_rho, (vfloat)BLEND_REAL(5.5412635451584261));
        vint on_plane = VMASK((c.q * inverse_d) * inverse_d <= circle), beyond_near = VMASK(c.d <= s->d_near);
//@@ camera_lowpass_depth
//@@ coplanar_lowpass_depth
        hit &= beyond_near;
        depth = VSELECT(FMA(circle * (depth_d - s->z_center * c.d), c.d / c.q, (vfloat)s->z_center), depth, on_plane);
    }
//@ lowpass_blocks_nearest
        if (HAS_LOWPASS(s)) min_depth = fmin(min_depth, (vfloat)fmax((1.0f - BLOCKS_SLACK) * s->z_center, s->z_center - s->z_reach));
//@ lowpass_depth_reach
#ifndef BOX_HERE
#define BOX_HERE false
#endif
    if (!BOX_HERE) depth_reach *= fmax(REAL(1.0), REAL(3.3290429691304455) / radius);
