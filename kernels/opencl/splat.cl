// Ray-splat intersection and Gaussian weight (2DGS, Huang et al. 2024, section 4); the only copy of this maths.
//
// Rows Tu, Tv, Tw of M = K [a b p] (a, b scaled tangents, p centre, camera space). The ray through pixel (x, y)
// intersects the splat's plane at (u, v) with (u, v, 1) D = (n_u, n_v, D) = Tu x Tv + x (Tv x Tw) + y (Tw x Tu):
// numerators and denominator are affine in the pixel. They are stored relative to an integer anchor pixel near the
// splat, so that x - anchor is exact and nothing cancels, with a common factor that makes D > 0 in front of the
// camera, and with sqrt(1/2) in the numerators, so that (n_u^2 + n_v^2) / D^2 is half of rho = u^2 + v^2, the squared distance
// in standard deviations. half_r2: half of the squared cut-off radius, at which alpha is the alpha cut-off.

//@@ struct View
//@@ struct Splat
typedef struct {
    vfloat d;               // denominator
    vfloat q;               // n_u^2 + n_v^2
    vint inside;            // the intersection is within the cut-off radius R and beyond the near plane
//@@ intersection
//@@ footprint_intersection
} Intersection;

//@@ footprint
#ifndef INVERSE_D
#define INVERSE_D(c) RECIPROCAL((c).d)
#define HALF_RHO(c, inverse_d) ((c).q * (inverse_d) * (inverse_d))
#endif
//@@ footprint_functions

// Affine forms at row coordinates y; `*_x` hold the terms that depend on the column only.
static inline Intersection intersect_row(const Splat *s, vfloat nu_x, vfloat nv_x, vfloat d_x, vfloat y, blend_real half_r2) {
    Intersection c;
    vfloat nu = FMA((vfloat)s->nuy, y, nu_x);
    vfloat nv = FMA((vfloat)s->nvy, y, nv_x);
    c.d = FMA((vfloat)s->dy, y, d_x);
    c.q = FMA(nu, nu, nv * nv);
    // product form: no division, and no special case for D = 0
    c.inside = VMASK(c.q <= half_r2 * (c.d * c.d)) & VMASK(c.d > 0.0f) & VMASK(c.d <= s->d_near);
//@@ footprint_intersect
    return c;
}

//@@ intersect_functions
// Alpha of a fragment: the splat's opacity times exp(-rho / 2), at most the opacity ceiling.
static inline vfloat fragment_alpha(const Splat *s, vfloat half_rho, blend_real opacity_ceiling) {
    return VMIN(EXP(s->log_opacity - half_rho), (vfloat)opacity_ceiling);
}
