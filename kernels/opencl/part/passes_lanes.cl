// Several passes through a tile's list, for CPUs: until all fragments and layers of all pixels are composited.
//@ compose_functions
// After the last splat of the list: composites what is left of this pass. Returns the lanes that require another pass.
static inline vint pass_finish(Pixel *pixel, global const Splat *splats, const BlendConstants *constants) {
    vint repeats = 0;
//@@ k_buffer_finish
//@@ layers_finish
    return repeats & pixel_unfinished(pixel, constants);
}
//@ pass
    do {
//@ pass_end
        alive = 0;
        for (int block = 0; block < BLOCKS; block++)
            if ((on_picture >> block & 1u) && VANY(pass_finish(&pixels[block], splats, &constants))) alive |= 1u << block;
    } while (alive);
