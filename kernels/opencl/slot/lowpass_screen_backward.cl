// Backward pass of the low-pass `screen`: through the larger of the two weights, that of the plane or that of the disc.
//@ fragment_branch
static inline vint fragment_on_plane(const Splat *s, Crossing c, vfloat half_rho, vfloat screen) {
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
    vfloat per_q = 1.0f / g->q, by_disc = VSELECT((vfloat)0.0f, by_z * per_q, g->disc);
    vfloat scaled_d = g->circle * g->d;
    vfloat beyond = s->z_numerator - s->z_center * g->d;
    vfloat by_screen = VSELECT((vfloat)0.0f, by_disc * beyond * g->d, VMASK(g->circle == screen));
    by_numerator = FMA(by_disc, scaled_d, by_numerator);
    by_center = FMA(-by_disc * scaled_d, g->d, by_center);
    by_d = FMA(by_disc * g->circle, beyond - s->z_center * g->d, by_d);
    by_q = -2.0f * VSELECT((vfloat)0.0f, by_disc * scaled_d * beyond * per_q, g->disc);
    *by_nu = FMA(by_q, g->nu, *by_nu);
    *by_nv = FMA(by_q, g->nv, *by_nv);
    sums->disc_x = FMA(-by_screen, x - s->disc_x, sums->disc_x);
    sums->disc_y = FMA(-by_screen, y - s->disc_y, sums->disc_y);
//@ sums
    vfloat disc_x, disc_y;
//@ fragment_backward
    vfloat by_disc = VSELECT(by_log, (vfloat)0.0f, g->on_plane);
    sums->disc_x = FMA(by_disc, x - s->disc_x, sums->disc_x);
    sums->disc_y = FMA(by_disc, y - s->disc_y, sums->disc_y);
//@ moments
    MOMENT(disc_x, 2.0f * constants->filter * sums->disc_x);
    MOMENT(disc_y, 2.0f * constants->filter * sums->disc_y);
//@ camera_backward
        // the disc's position is tu.z / pz
        by_tu.z += total.disc_x / pz;
        by_tv.z += total.disc_y / pz;
        by_tw.z -= (total.disc_x * tu.z + total.disc_y * tv.z) / (pz * pz);
