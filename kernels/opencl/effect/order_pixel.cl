// Alpha compositing by fragment depth at each pixel. Lists are sorted by `nearest`, a lower bound of the depths of a splat's
// fragments, with the rounding of blending: no later fragment is nearer than the current splat's key, so that all fragments in front of
// the key are composited by depth, then by position in the list. Other fragments stay in the k-buffer (part/k_buffer_*.cl), which holds
// K_BUFFER_SIZE per pixel. When it is full, the farthest fragment is dropped, with all behind it (`until`), and another pass
// through the list composites the dropped fragments (`from`), until none is left: the image does not depend on K_BUFFER_SIZE.
//
// Depths are clamped to the range in which the splat has at least 1/255 of its opacity, at any alpha cut-off, so that a cut-off
// does not change the order.
//@ functions
#define RANGE_RADIUS REAL(3.3290429691304455)   // sqrt(2 ln 255)
#ifndef BOX_HERE
#define BOX_HERE false
#endif
//@ depth_reach
    depth_reach = BOX_HERE ? reach : reach * (RANGE_RADIUS / radius);
//@ depth_nearest
    record.nearest = (blend_real)convert_float_rtn(record.z_center - record.z_reach);
//@@ coplanar_nearest
//@ key
    key = (float)record.nearest;
//@ state
    KBuffer k_buffer;
//@ start
    k_buffer_start(&pixel->k_buffer);
//@ blend_parameters
                               , global const Splat *splats, uint splat, uint position, vfloat next_nearest
//@ blend_fragment
    k_buffer_insert(pixel, next_nearest, attributes.z, alpha, &attributes, splat, position, mask, splats, constants);
