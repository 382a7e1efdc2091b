// Without a low-pass every fragment is on its splat's plane.
//@ fragment_branch
static inline vint fragment_on_plane(const Splat *s, Crossing c, vfloat half_rho, vfloat screen) { return c.inside; }
