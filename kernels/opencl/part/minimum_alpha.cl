// Minimum alpha of a sample in depth, normal and label outputs. A low alpha cut-off renders the far rims of splats, which matter
// for colours but should not be part of a mask.
//@ compose_types
#define MIN_ALPHA (WIDE(1.0) / WIDE(255.0))
//@ compose_functions
// Valid once the pixel is complete.
static inline vint pixel_covered(const Pixel *pixel) {
    return VMASK(1.0f - pixel->t >= MIN_ALPHA);
}

