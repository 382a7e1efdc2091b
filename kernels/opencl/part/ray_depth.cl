// Depth along z of a fragment, for those that need it: the ray's meeting with the splat's plane, within the
// depth range of the R-sigma disk; in the low-pass dot of a splat whose plane the ray misses, the centre's depth
// (numerics B2, B4).
//@ project
    record.z_numerator = (wide)z_numerator;
    record.z_center = (wide)pz;
    record.z_reach = (wide)reach;
//@@ depth_reach
//@ seen
    vfloat z;
//@ see
    seen.z = VSELECT((vfloat)s->z_center,
                     VMIN(VMAX(s->z_numerator * inverse_d, (vfloat)s->z_center - (vfloat)s->z_reach),
                          (vfloat)s->z_center + (vfloat)s->z_reach),
                     VMASK(c.d > 0.0f));
//@@ see_depth
//@ gather
    layer->mean.z = FMA(share, seen->z - layer->mean.z, layer->mean.z);
