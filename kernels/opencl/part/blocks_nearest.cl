// Minimum depth of a splat's fragments in each block, for CPUs.
//@ blocks_nearest
        vfloat min_depth = s->z_center - s->z_reach;
//@@ camera_blocks_nearest
//@@ lowpass_blocks_nearest
//@@ coplanar_blocks_nearest
