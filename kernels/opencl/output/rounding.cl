// rounding (h, w): upper bound of what float32 changes in rgb, per unit of colour. Of pictures without a transmittance stop alone: the
// output `error` is made of it (fidsplat/render/certified_error.py has the derivation). By intervals of each fragment's forms, as
// fidsplat/backends/reference/error_bounds.py: the opacity lies between `low` and `high`, and the colour moves by no more than the
// transmittance in front times the distance from the opacity that is blended to the further of them. Fragments that rounding may take
// away (near plane, horizon, rim) count too, so that all that are listed are asked, not only those that are blended. Each that is
// blended rounds the transmittance and the sum of colours, together by UNIT, and this sum by half of that.
//@ state
    vfloat rounding;
//@ start
    pixel->rounding = 0.0f;
//@ compose_functions
#define UNIT 0x1p-24f
#define FORM_ROUNDING (4.0f * UNIT)        // of a form, relative to its terms: three coefficients, and its sums
#define FORM_TERMS(n0, nx, ny) (fabs((vfloat)(n0)) + fabs((vfloat)(nx)) * across + fabs((vfloat)(ny)) * down)

static inline vfloat squared(vfloat x) { return x * x; }

// What rounding changes in an opacity of half rho `h`, relative: ln(opacity), rho (a root, a division and a square by OpenCL's
// bounds), their difference, and the exponential.
static inline vfloat opacity_rounding(const Splat *s, vfloat h) {
    return UNIT * (16.0f + 2.0f * fabs((vfloat)s->log_opacity) + 32.0f * fmin(h, (vfloat)100.0f));
}

static inline void add_rounding(Pixel *pixel, const Splat *s, Crossing c, vfloat x, vfloat y, vint mask, vfloat screen,
                                const BlendConstants *constants) {
    vfloat across = fabs(x), down = fabs(y);
    vfloat off = FORM_ROUNDING * (FORM_TERMS(s->nu0, s->nux, s->nuy) + FORM_TERMS(s->nv0, s->nvx, s->nvy));
    vfloat off_d = FORM_ROUNDING * FORM_TERMS(s->d0, s->dx, s->dy), d_low = c.d - off_d, d_high = c.d + off_d, root = sqrt(c.q);
    vint may = VMASK(d_high > 0.0f) & VMASK(d_low <= (1.0f + FORM_ROUNDING) * s->d_near);
    vint must = VMASK(d_low > 0.0f) & VMASK(d_high <= (1.0f - FORM_ROUNDING) * s->d_near);
    vfloat nearest = VSELECT((vfloat)INFINITY, squared(fmax(root - off, (vfloat)0.0f) / d_high), may);
    vfloat furthest = VSELECT((vfloat)INFINITY, squared((root + off) / d_low), must);
#ifdef HAS_DOT
    if (HAS_DOT(s)) {
        vfloat away = sqrt(screen);
        vfloat off_dot = FORM_ROUNDING * (sqrt(constants->filter) * (1.0f + 2.0f * (across + down)) + 3.0f * away);
        nearest = fmin(nearest, squared(fmax(away - off_dot, (vfloat)0.0f)));
        furthest = fmin(furthest, squared(away + off_dot));
    }
#endif
    vfloat high = fmin(fragment_opacity(s, nearest, 1.0f) * (1.0f + opacity_rounding(s, nearest)), (vfloat)1.0f);
    vfloat low = fragment_opacity(s, furthest, 1.0f) * (1.0f - opacity_rounding(s, furthest));
    vfloat opacity = fragment_opacity(s, fragment_half_rho(s, c, 1.0f / c.d, screen), constants->ceiling);
    opacity = VSELECT((vfloat)0.0f, opacity, mask);
    vint blended = mask & VMASK(pixel->t > 0.0f);
    pixel->rounding += pixel->t * fmax(high - opacity, opacity - low) + VSELECT((vfloat)0.0f, (vfloat)(1.5f * UNIT), blended);
}
//@ mask
#if LANES == 1
                add_rounding(&pixels[row], &s, c, x, y, mask, screen, &constants);
#else
            add_rounding(&pixel, &s, c, x, y, mask, screen, &constants);
#endif
//@ store
        BLOCK_STORE(pixel->rounding, rounding_raw + at, stride);
//@ resolve_start
    float rounding = 0;
//@ resolve_sample
            rounding += rounding_raw[at];
//@ resolve_end
    rounding_out[out] = mean * rounding;
