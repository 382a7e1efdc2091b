// rounding (h, w): upper bound of the float32 rounding error in rgb, per unit of colour, for frames without a transmittance stop;
// part of the output `error` (derivation: fidsplat/render/certified_error.py). Interval arithmetic on the affine forms of the
// ray-splat intersection, as in fidsplat/backends/reference/error_bounds.py, bounds a fragment's alpha by `low` and `high`. The
// colour changes by at most the transmittance times the larger of high - alpha and alpha - low. The bound includes fragments that
// rounding may discard (at the near plane, at the horizon of the splat's plane, at the edge of the footprint), so all listed fragments
// are evaluated. Each blended fragment adds 1.5 UNIT for the rounding of transmittance and colour sum (step 4 of the derivation).
//@ state
    vfloat rounding;
//@ start
    pixel->rounding = 0.0f;
//@ blend_functions
#define UNIT 0x1p-24f
#define FORM_ROUNDING (4.0f * UNIT)        // relative rounding of a form: three coefficients, and its sums
#define FORM_TERMS(n0, nx, ny) (fabs((vfloat)(n0)) + fabs((vfloat)(nx)) * across + fabs((vfloat)(ny)) * down)

static inline vfloat squared(vfloat x) { return x * x; }

// Relative rounding of an alpha at half rho `h`: of ln(opacity), rho (a root, a division and a square by OpenCL's bounds), their
// difference, and the exponential.
static inline vfloat alpha_rounding(const Splat *s, vfloat h) {
    return UNIT * (16.0f + 2.0f * fabs((vfloat)s->log_opacity) + 32.0f * fmin(h, (vfloat)100.0f));
}

static inline void add_rounding(Pixel *pixel, const Splat *s, Intersection c, vfloat x, vfloat y, vint mask, vfloat lowpass_half_rho,
                                const BlendConstants *constants) {
    vfloat across = fabs(x), down = fabs(y);
    vfloat off = FORM_ROUNDING * (FORM_TERMS(s->nu0, s->nux, s->nuy) + FORM_TERMS(s->nv0, s->nvx, s->nvy));
    vfloat off_d = FORM_ROUNDING * FORM_TERMS(s->d0, s->dx, s->dy), d_low = c.d - off_d, d_high = c.d + off_d, root = sqrt(c.q);
    vint may = VMASK(d_high > 0.0f) & VMASK(d_low <= (1.0f + FORM_ROUNDING) * s->d_near);
    vint must = VMASK(d_low > 0.0f) & VMASK(d_high <= (1.0f - FORM_ROUNDING) * s->d_near);
    vfloat nearest = VSELECT((vfloat)INFINITY, squared(fmax(root - off, (vfloat)0.0f) / d_high), may);
    vfloat furthest = VSELECT((vfloat)INFINITY, squared((root + off) / d_low), must);
#ifdef HAS_LOWPASS
    if (HAS_LOWPASS(s)) {
        vfloat away = sqrt(lowpass_half_rho);
        vfloat off_lowpass = FORM_ROUNDING * (sqrt(constants->sample_area) * (1.0f + 2.0f * (across + down)) + 3.0f * away);
        nearest = fmin(nearest, squared(fmax(away - off_lowpass, (vfloat)0.0f)));
        furthest = fmin(furthest, squared(away + off_lowpass));
    }
#endif
    vfloat high = fmin(fragment_alpha(s, nearest, 1.0f) * (1.0f + alpha_rounding(s, nearest)), (vfloat)1.0f);
    vfloat low = fragment_alpha(s, furthest, 1.0f) * (1.0f - alpha_rounding(s, furthest));
    vfloat alpha = fragment_alpha(s, fragment_half_rho(s, c, INVERSE_D(c), lowpass_half_rho), constants->opacity_ceiling);
    alpha = VSELECT((vfloat)0.0f, alpha, mask);
    vint blended = mask & VMASK(pixel->t > 0.0f);
    pixel->rounding += pixel->t * fmax(high - alpha, alpha - low) + VSELECT((vfloat)0.0f, (vfloat)(1.5f * UNIT), blended);
}
//@ mask
#if LANES == 1
                add_rounding(&pixels[row], &s, c, x, y, mask, lowpass_half_rho, &constants);
#else
            add_rounding(&pixel, &s, c, x, y, mask, lowpass_half_rho, &constants);
#endif
//@ store
        BLOCK_STORE(pixel->rounding, rounding_raw + at, stride);
//@ resolve_start
    float rounding = 0;
//@ resolve_sample
            rounding += rounding_raw[at];
//@ resolve_end
    rounding_out[out] = mean * rounding;
