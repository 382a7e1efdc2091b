// The end of a pass through a tile's list, where there may be several (passes_lanes.cl, passes_group.cl).
//@ blend_functions
// After the last splat of the list: composites what is left of this pass. Returns the lanes that require another pass.
static inline vint pass_finish(Pixel *pixel, global const Splat *splats, const BlendConstants *constants) {
    vint repeats = 0;
//@@ k_buffer_finish
//@@ layers_finish
    return repeats & pixel_unfinished(pixel, constants);
}
