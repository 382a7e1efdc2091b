// Depth along z of a fragment, for the taps that need it: the ray's meeting with the splat's plane, within the
// depth range of the R-sigma disk; in the low-pass dot of a splat whose plane the ray misses, the centre's depth
// (numerics B2, B4).
//@ record
    float z_numerator;      // depth = z_numerator / D
    float z_center, z_reach;
//@ project
    record.z_numerator = (float)z_numerator;
    record.z_center = (float)pz;
    record.z_reach = (float)reach;
//@ fragment
    vfloat fragment_z = VSELECT((vfloat)s->z_center,
                                clamp(s->z_numerator * inverse_d, (vfloat)(s->z_center - s->z_reach),
                                      (vfloat)(s->z_center + s->z_reach)),
                                VMASK(c.d > 0.0f));
