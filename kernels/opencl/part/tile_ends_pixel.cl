// For stores (fidsplat/backends/termination_depth.py), by depth at each pixel: of each tile the furthest of the depths at which its pixels were
// finished, as a sort key; that of infinity where one was not. Fragments behind that are composited behind it, whichever there are, and
// change nothing. A layer is taken by a depth that is not quite its own (slot/compose_planes.cl).
//@ state
    vfloat ended;               // depth of what was composited last
//@ start
    pixel->ended = -INFINITY;
//@ composite
    pixel->ended = VSELECT(pixel->ended, FMA(fabs(seen->z), (vfloat)0x1p-14f, seen->z), live);
//@ compose_functions
// Behind all that can show of a pixel.
static inline vfloat pixel_end(const Pixel *pixel, const BlendConstants *constants) {
    return VSELECT(pixel->ended, (vfloat)INFINITY, pixel_lit(pixel, constants));
}
