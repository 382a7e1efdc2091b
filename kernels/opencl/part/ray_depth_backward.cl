// Depth of a fragment: z_numerator / D; where that leaves the depth range of the disk (in the dot of the low-pass) an end of the range,
// and the centre's where the ray does not meet the plane in front.
//@ geometry
    vfloat z;
    vint met, beyond;       // the ray meets the plane in front; the depth is beyond the disk's range
//@ geometry_make
    g.met = VMASK(c.d > 0.0f);
    vfloat z_plane = s->z_numerator * g.inverse_d;
    vfloat z_low = s->z_center - s->z_reach, z_high = s->z_center + s->z_reach;
    g.z = VSELECT((vfloat)s->z_center, clamp(z_plane, z_low, z_high), g.met);
    g.beyond = g.met & (VMASK(z_plane < z_low) | VMASK(z_plane > z_high));
//@ sums
    vfloat z_numerator, z_center, z_reach;
//@ fragment_functions
// Adds the derivative by a fragment's depth; returns that by D.
static inline vfloat add_depth(Sums *sums, const Splat *s, const Geometry *g, vfloat by_z) {
    vfloat by_met = VSELECT((vfloat)0.0f, by_z * g->inverse_d, g->met & ~g->beyond);
    sums->z_numerator += by_met;
    sums->z_center += VSELECT(by_z, (vfloat)0.0f, g->met & ~g->beyond);
    sums->z_reach += VSELECT((vfloat)0.0f, VSELECT(by_z, -by_z, VMASK(g->z < s->z_center)), g->beyond);
    return -VSELECT((vfloat)0.0f, by_met * g->z, g->met & ~g->beyond);
}

//@ moments
    MOMENT(z_numerator, sums->z_numerator);
    MOMENT(z_center, sums->z_center);
    MOMENT(z_reach, sums->z_reach);
//@ camera_backward
        // z_numerator is the determinant of M, with its sign
        real by_volume = facing * total.z_numerator;
        by_tu = add3(by_tu, scaled(by_volume, kx));
        by_tv = add3(by_tv, scaled(by_volume, ky));
        by_tw = add3(by_tw, scaled(by_volume, k0));
//@ disk_backward
        real reach_radius = sqrt(2 * (log((real)opacities[i]) - view->log_cut)), steep = sqrt(a.z * a.z + b.z * b.z);
        by_p.z += total.z_center;
        by_log += total.z_reach * steep / reach_radius;
        if (steep > 0) {
            by_a.z += total.z_reach * reach_radius * a.z / steep;
            by_b.z += total.z_reach * reach_radius * b.z / steep;
        }
