// Backward pass of the low-pass `screen`: through the larger of the two weights, that of the plane or that of the disc.
//@ fragment_branch
static inline vint fragment_on_plane(const Splat *s, Crossing c, vfloat half_rho, vfloat screen) {
    return HAS_DOT(s) ? c.inside & VMASK(half_rho <= screen) : c.inside;
}
//@ dot_geometry
    vint dot;               // depth reflected at `circle`: z_center + circle (z_numerator - z_center D) D / q
    vfloat circle;
//@ dot_geometry_make
    g.circle = HAS_DOT(s) ? max(screen, (vfloat)WIDE(5.5412635451584261)) : (vfloat)1e30f;
    vint ahead = VMASK(c.d > 0.0f) & VMASK(c.d <= s->d_near);
    flat = ahead & VMASK(g.half_rho <= g.circle);
    g.dot = ahead & ~flat;
    vfloat dot_depth = FMA(g.circle * (s->z_numerator - s->z_center * c.d), c.d / c.q, (vfloat)s->z_center);
    depth = VSELECT(VSELECT((vfloat)s->z_center, dot_depth, g.dot), depth, flat);
//@ dot_add_depth
    vfloat per_q = 1.0f / FMA(g->nu, g->nu, g->nv * g->nv), by_dot = VSELECT((vfloat)0.0f, by_z * per_q, g->dot), taken = g->circle * g->d;
    vfloat beyond = s->z_numerator - s->z_center * g->d, by_screen = VSELECT((vfloat)0.0f, by_dot * beyond * g->d, VMASK(g->circle == screen));
    by_numerator = FMA(by_dot, taken, by_numerator);
    by_center = FMA(-by_dot * taken, g->d, by_center);
    by_d = FMA(by_dot * g->circle, beyond - s->z_center * g->d, by_d);
    by_dot = -2.0f * VSELECT((vfloat)0.0f, by_dot * taken * beyond * per_q, g->dot);        // by n_u over n_u, by n_v over n_v
    *by_nu = FMA(by_dot, g->nu, *by_nu);
    *by_nv = FMA(by_dot, g->nv, *by_nv);
    sums->dot_x = FMA(-by_screen, x - s->dot_x, sums->dot_x);
    sums->dot_y = FMA(-by_screen, y - s->dot_y, sums->dot_y);
//@ sums
    vfloat dot_x, dot_y;
//@ fragment_backward
    vfloat by_dot = VSELECT(by_log, (vfloat)0.0f, g->on_plane);
    sums->dot_x = FMA(by_dot, x - s->dot_x, sums->dot_x);
    sums->dot_y = FMA(by_dot, y - s->dot_y, sums->dot_y);
//@ moments
    MOMENT(dot_x, 2.0f * constants->filter * sums->dot_x);
    MOMENT(dot_y, 2.0f * constants->filter * sums->dot_y);
//@ camera_backward
        // the disc's position is tu.z / pz
        by_tu.z += total.dot_x / pz;
        by_tv.z += total.dot_y / pz;
        by_tw.z -= (total.dot_x * tu.z + total.dot_y * tv.z) / (pz * pz);
