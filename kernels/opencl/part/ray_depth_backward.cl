// Backward pass of fragment depth: z_numerator / D, or the depth of the centre where the ray does not intersect the plane. Depths that
// rounding moves out of the splat's depth range have the gradient of the centre's depth.
//@ geometry
    vfloat d, z;
    vint hit;               // the depth is z_numerator / D
//@@ lowpass_geometry
//@ geometry_make
    g.d = c.d;
    vfloat z_low = s->z_center - s->z_reach, z_high = s->z_center + s->z_reach, depth = s->z_numerator * g.inverse_d;
    vint flat = g.on_plane;                 // the depth is on the plane, if within range
//@@ lowpass_geometry_make
    g.hit = flat & VMASK(depth >= z_low) & VMASK(depth <= z_high);
    g.z = clamp(depth, z_low, z_high);
//@ sums
    vfloat z_numerator, z_center;
//@ fragment_functions
// Adds the gradient with respect to a fragment's depth at (x, y) from the anchor; returns the gradient with respect to D.
static inline vfloat add_depth(Sums *sums, const Splat *s, const Geometry *g, vfloat grad_z, vfloat lowpass_half_rho, vfloat x, vfloat y,
                               vfloat *grad_nu, vfloat *grad_nv) {
    vfloat grad_numerator = VSELECT((vfloat)0.0f, grad_z * g->inverse_d, g->hit), grad_d = -grad_numerator * g->z;
    vfloat grad_center = VSELECT(grad_z, (vfloat)0.0f, g->hit), grad_q = 0.0f;     // grad_q n_u, grad_q n_v: gradients with respect to n_u, n_v
//@@ lowpass_add_depth
//@@ footprint_add_depth
    sums->z_numerator += grad_numerator;
    sums->z_center += grad_center;
    return grad_d;
}

//@ record_gradients
    STORE_SUM(z_numerator, sums->z_numerator);
    STORE_SUM(z_center, sums->z_center);
//@ camera_backward
        // z_numerator is the signed determinant of M
        real grad_volume = facing * total.z_numerator;
        grad_tu = add3(grad_tu, scaled(grad_volume, kx));
        grad_tv = add3(grad_tv, scaled(grad_volume, ky));
        grad_tw = add3(grad_tw, scaled(grad_volume, k0));
//@ disk_backward
        grad_p.z += total.z_center;
