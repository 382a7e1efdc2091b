// Backward pass of the low-pass `screen`: through the larger of the two weights, that of the plane or that of the disc.
//@ fragment_branch
static inline vint fragment_on_plane(const Splat *s, Intersection c, vfloat half_rho, vfloat lowpass_half_rho) {
    return HAS_LOWPASS(s) ? c.inside & VMASK(half_rho <= lowpass_half_rho) : c.inside;
}
//@ lowpass_geometry
    vint lowpass;               // depth reflected at `circle`: z_center + circle (z_numerator - z_center D) D / q
    vfloat circle, q;
//@ lowpass_geometry_make
    g.q = c.q;
    g.circle = HAS_LOWPASS(s) ? max(lowpass_half_rho, (vfloat)BLEND_REAL(5.5412635451584261)) : (vfloat)1e30f;
    vint ahead = VMASK(c.d > 0.0f) & VMASK(c.d <= s->d_near);
    flat = ahead & VMASK(g.half_rho <= g.circle);
    g.lowpass = ahead & ~flat;
    vfloat lowpass_depth = FMA(g.circle * (s->z_numerator - s->z_center * c.d), c.d / c.q, (vfloat)s->z_center);
    depth = VSELECT(VSELECT((vfloat)s->z_center, lowpass_depth, g.lowpass), depth, flat);
//@ lowpass_add_depth
    vfloat per_q = 1.0f / g->q, grad_lowpass = VSELECT((vfloat)0.0f, grad_z * per_q, g->lowpass);
    vfloat scaled_d = g->circle * g->d;
    vfloat beyond = s->z_numerator - s->z_center * g->d;
    vfloat grad_screen = VSELECT((vfloat)0.0f, grad_lowpass * beyond * g->d, VMASK(g->circle == lowpass_half_rho));
    grad_numerator = FMA(grad_lowpass, scaled_d, grad_numerator);
    grad_center = FMA(-grad_lowpass * scaled_d, g->d, grad_center);
    grad_d = FMA(grad_lowpass * g->circle, beyond - s->z_center * g->d, grad_d);
    grad_q = -2.0f * VSELECT((vfloat)0.0f, grad_lowpass * scaled_d * beyond * per_q, g->lowpass);
    *grad_nu = FMA(grad_q, g->nu, *grad_nu);
    *grad_nv = FMA(grad_q, g->nv, *grad_nv);
    sums->lowpass_x = FMA(-grad_screen, x - s->lowpass_x, sums->lowpass_x);
    sums->lowpass_y = FMA(-grad_screen, y - s->lowpass_y, sums->lowpass_y);
//@ sums
    vfloat lowpass_x, lowpass_y;
//@ fragment_backward
    vfloat grad_lowpass = VSELECT(grad_log, (vfloat)0.0f, g->on_plane);
    sums->lowpass_x = FMA(grad_lowpass, x - s->lowpass_x, sums->lowpass_x);
    sums->lowpass_y = FMA(grad_lowpass, y - s->lowpass_y, sums->lowpass_y);
//@ record_gradients
    STORE_SUM(lowpass_x, 2.0f * constants->sample_area * sums->lowpass_x);
    STORE_SUM(lowpass_y, 2.0f * constants->sample_area * sums->lowpass_y);
//@ camera_backward
        // the disc's position is tu.z / pz
        grad_tu.z += total.lowpass_x / pz;
        grad_tv.z += total.lowpass_y / pz;
        grad_tw.z -= (total.lowpass_x * tu.z + total.lowpass_y * tv.z) / (pz * pz);
