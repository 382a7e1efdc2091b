// Several passes through a tile's list, for GPUs: until all fragments and layers of all pixels are composited. A pass skips splats that
// end in front of the depth at which it begins (`from`).
//@ unfinished
//@@ pass_unfinished
//@ blend_types
#ifndef IN_LAYER
#define IN_LAYER(s) false
#endif
//@ blend_functions
// Fragments in front of this depth belong to earlier passes.
static inline blend_real pass_from(const Pixel *pixel) {
    blend_real from = -INFINITY;
//@@ pass_from
    return from;
}
//@ group_start
    local uint next_from;
    blend_real from = -INFINITY;
//@ cells_parameters
                                 , blend_real from
//@ cells_arguments
                          , from
//@ cells_occluded
    if (!IN_LAYER(s) && s->z_center + s->z_reach < from) return;
//@ pass
    do {
//@ pass_end
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) next_from = 0xFFFFFFFFu;     // no further pass
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int row = 0; row < ROWS; row++)
            if (px < width && py + row < height && pass_finish(&pixels[row], splats, &constants))
                atomic_min(&next_from, sortable(convert_float_rtn(pass_from(&pixels[row]))));
        barrier(CLK_LOCAL_MEM_FENCE);
        from = key_depth(next_from);
        // uniform: every work-item reads the same depth
    } while (next_from != 0xFFFFFFFFu);
