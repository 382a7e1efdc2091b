// No low-pass filter.
//@ fragment_mask
static inline vint fragment_mask(const Splat *s, Intersection c, vfloat x, vfloat y, blend_real half_r2, blend_real sample_area,
                                 vfloat *lowpass_half_rho) {
    return c.inside;
}
//@ fragment_half_rho
static inline vfloat fragment_half_rho(const Splat *s, Intersection c, vfloat inverse_d, vfloat lowpass_half_rho) {
    return HALF_RHO(c, inverse_d);
}
