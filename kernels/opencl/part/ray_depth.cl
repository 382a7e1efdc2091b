// Depth along z of a fragment, for those that need it: where the ray meets the splat's plane, within the depth range of the part that can
// be visible; the centre's where the ray meets no plane beyond `near` (numerics B2, B4). slot/lowpass_screen.cl has that of its dots.
//@ crossing
//@@ dot_crossing
//@ mask
//@@ dot_mask
//@ project
    // of all that is drawn, and of what the low-pass's dot shows whatever the cut-off
    real depth_center = pz, depth_reach = reach;
//@@ dot_depth_reach
//@@ depth_reach
    if (pz < near) {                // fragments lie beyond `near`
        real furthest = fmax(near, pz + depth_reach);
        depth_center = REAL(0.5) * (furthest + near);
        depth_reach = REAL(0.5) * (furthest - near);
    }
    record.z_numerator = (wide)z_numerator;
    record.z_center = (wide)depth_center;
    record.z_reach = (wide)depth_reach;
//@@ depth_nearest
//@ attributes
    vfloat z;
//@ attribute_values
    vfloat depth_d = s->z_numerator;        // depth times D
//@@ camera_attribute_depth
    vfloat depth = depth_d * inverse_d;
    vint hit = VMASK(c.d > 0.0f);
//@@ dot_attribute_depth
    attributes.z = VSELECT((vfloat)s->z_center,
                     VMIN(VMAX(depth, (vfloat)s->z_center - (vfloat)s->z_reach), (vfloat)s->z_center + (vfloat)s->z_reach), hit);
//@@ coplanar_attribute_depth
//@ layer_accumulate
    layer->mean.z = FMA(share, attributes->z - layer->mean.z, layer->mean.z);
