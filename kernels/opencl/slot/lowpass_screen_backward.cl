// Backward pass of the low-pass `screen`: through the larger of the two weights, that of the plane or that of the disc.
//@ fragment_branch
static inline vint fragment_on_plane(const Splat *s, Intersection c, vfloat half_rho, vfloat screen) {
    return HAS_DISC(s) ? c.inside & VMASK(half_rho <= screen) : c.inside;
}
//@ disc_geometry
    vint disc;               // depth reflected at `circle`: z_center + circle (z_numerator - z_center D) D / q
    vfloat circle, q;
//@ disc_geometry_make
    g.q = c.q;
    g.circle = HAS_DISC(s) ? max(screen, (vfloat)WIDE(5.5412635451584261)) : (vfloat)1e30f;
    vint ahead = VMASK(c.d > 0.0f) & VMASK(c.d <= s->d_near);
    flat = ahead & VMASK(g.half_rho <= g.circle);
    g.disc = ahead & ~flat;
    vfloat disc_depth = FMA(g.circle * (s->z_numerator - s->z_center * c.d), c.d / c.q, (vfloat)s->z_center);
    depth = VSELECT(VSELECT((vfloat)s->z_center, disc_depth, g.disc), depth, flat);
//@ disc_add_depth
    vfloat per_q = 1.0f / g->q, grad_disc = VSELECT((vfloat)0.0f, grad_z * per_q, g->disc);
    vfloat scaled_d = g->circle * g->d;
    vfloat beyond = s->z_numerator - s->z_center * g->d;
    vfloat grad_screen = VSELECT((vfloat)0.0f, grad_disc * beyond * g->d, VMASK(g->circle == screen));
    grad_numerator = FMA(grad_disc, scaled_d, grad_numerator);
    grad_center = FMA(-grad_disc * scaled_d, g->d, grad_center);
    grad_d = FMA(grad_disc * g->circle, beyond - s->z_center * g->d, grad_d);
    grad_q = -2.0f * VSELECT((vfloat)0.0f, grad_disc * scaled_d * beyond * per_q, g->disc);
    *grad_nu = FMA(grad_q, g->nu, *grad_nu);
    *grad_nv = FMA(grad_q, g->nv, *grad_nv);
    sums->disc_x = FMA(-grad_screen, x - s->disc_x, sums->disc_x);
    sums->disc_y = FMA(-grad_screen, y - s->disc_y, sums->disc_y);
//@ sums
    vfloat disc_x, disc_y;
//@ fragment_backward
    vfloat grad_disc = VSELECT(grad_log, (vfloat)0.0f, g->on_plane);
    sums->disc_x = FMA(grad_disc, x - s->disc_x, sums->disc_x);
    sums->disc_y = FMA(grad_disc, y - s->disc_y, sums->disc_y);
//@ record_gradients
    STORE_SUM(disc_x, 2.0f * constants->filter * sums->disc_x);
    STORE_SUM(disc_y, 2.0f * constants->filter * sums->disc_y);
//@ camera_backward
        // the disc's position is tu.z / pz
        grad_tu.z += total.disc_x / pz;
        grad_tv.z += total.disc_y / pz;
        grad_tw.z -= (total.disc_x * tu.z + total.disc_y * tv.z) / (pz * pz);
