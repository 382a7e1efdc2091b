// The low-pass `screen`: derivatives go through the larger of the two weights, by the dot's place where that is the dot's.
//@ fragment_branch
static inline vint fragment_on_plane(const Splat *s, Crossing c, vfloat half_rho, vfloat screen) {
    return HAS_DOT(s) ? c.inside & VMASK(half_rho <= screen) : c.inside;
}
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
        // the dot's place is tu.z / pz
        by_tu.z += total.dot_x / pz;
        by_tv.z += total.dot_y / pz;
        by_tw.z -= (total.dot_x * tu.z + total.dot_y * tv.z) / (pz * pz);
