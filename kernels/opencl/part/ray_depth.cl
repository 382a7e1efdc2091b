// Depth along z of a fragment: the ray-plane intersection, clamped to the depth range of the splat's visible part; the depth of the
// centre where the ray does not intersect the plane beyond `near`. effect/lowpass_screen.cl has the depth of low-pass fragments.
//@ intersection
//@@ lowpass_intersection
//@ mask
//@@ lowpass_mask
//@ project
    // range of all fragments, including the low-pass disc at any alpha cut-off
    real depth_center = pz, depth_reach = reach;
//@@ lowpass_depth_reach
//@@ depth_reach
//@@ coplanar_depth_reach
    if (pz < near) {                // all fragments are beyond `near`
        real furthest = fmax(near, pz + depth_reach);
        depth_center = REAL(0.5) * (furthest + near);
        depth_reach = REAL(0.5) * (furthest - near);
    }
    record.z_numerator = (blend_real)z_numerator;
    record.z_center = (blend_real)depth_center;
    record.z_reach = (blend_real)depth_reach;
//@@ depth_nearest
//@ attributes
    vfloat z;
//@ attribute_values
    vfloat depth_d = s->z_numerator;        // depth times D
//@@ camera_attribute_depth
    vfloat depth = depth_d * inverse_d;
    vint hit = VMASK(c.d > 0.0f);
//@@ lowpass_attribute_depth
    attributes.z = VSELECT((vfloat)s->z_center,
                     VMIN(VMAX(depth, (vfloat)s->z_center - (vfloat)s->z_reach), (vfloat)s->z_center + (vfloat)s->z_reach), hit);
//@ layer_accumulate
    layer->mean.z = FMA(share, attributes->z - layer->mean.z, layer->mean.z);
