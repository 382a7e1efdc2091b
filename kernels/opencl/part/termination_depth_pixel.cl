// For stores (fidsplat/backends/termination_depth.py), by depth at each pixel: of each tile the furthest of the depths at which its pixels were
// finished, as a sort key; that of infinity where one was not. Fragments behind that are composited behind it, whichever there are, and
// change nothing. A layer is taken by a depth that is not quite its own (slot/compose_coplanar.cl).
//@ state
    vfloat termination_depth;               // depth of what was composited last
//@ start
    pixel->termination_depth = -INFINITY;
//@ composite
    pixel->termination_depth = VSELECT(pixel->termination_depth, FMA(fabs(attributes->z), (vfloat)0x1p-14f, attributes->z), live);
//@ compose_functions
// Behind all that can show of a pixel.
static inline vfloat pixel_termination(const Pixel *pixel, const BlendConstants *constants) {
    return VSELECT(pixel->termination_depth, (vfloat)INFINITY, pixel_transmits(pixel, constants));
}
