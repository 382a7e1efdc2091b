// Minimum alpha of a sample in depth, normal and label outputs. A low alpha cut-off renders the far rims of splats, which matter
// for colours but should not be part of a mask.
//@ blend_types
#define MIN_ALPHA (BLEND_REAL(1.0) / BLEND_REAL(255.0))
//@ blend_functions
// Valid once the pixel is complete.
static inline vint pixel_covered(const Pixel *pixel) {
    return VMASK(1.0f - pixel->t >= MIN_ALPHA);
}

