// What the outputs that name or measure what is seen take for nothing: a sample that is covered by less than this. A low cut-off
// draws the far rims of splats, for the sake of colours; nobody would call them part of a mask.
//@ compose_types
#define MIN_ALPHA (WIDE(1.0) / WIDE(255.0))
//@ compose_functions
// To be asked once the pixel is finished.
static inline vint pixel_covered(const Pixel *pixel) {
    return VMASK(1.0f - pixel->t >= MIN_ALPHA);
}

