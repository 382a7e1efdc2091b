// Termination depth of each tile for occlusion culling (fidsplat/backends/termination_depth.py), in pixel order: the largest depth at
// which one of its pixels was terminated, as a sort key, or infinity if one was not. Fragments behind it cannot change the tile. The
// margin covers the depth offset of coplanar layers (effect/order_coplanar.cl).
//@ state
    vfloat termination_depth;               // depth of the last composited fragment
//@ start
    pixel->termination_depth = -INFINITY;
//@ composite
    pixel->termination_depth = VSELECT(pixel->termination_depth, FMA(fabs(attributes->z), (vfloat)0x1p-14f, attributes->z), live);
//@ blend_functions
// Depth behind which nothing contributes to a pixel.
static inline vfloat pixel_termination(const Pixel *pixel, const BlendConstants *constants) {
    return VSELECT(pixel->termination_depth, (vfloat)INFINITY, pixel_transmits(pixel, constants));
}
