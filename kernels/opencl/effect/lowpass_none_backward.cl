// Without a low-pass every fragment has the weight of the plane.
//@ fragment_branch
static inline vint fragment_on_plane(const Splat *s, Intersection c, vfloat half_rho, vfloat lowpass_half_rho) { return c.inside; }
