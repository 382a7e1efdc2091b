// Length of a lens ray (Z = 1) through a sample per unit of depth along z.
//@ functions
static inline float lens_ray_length(global const float *restrict rays, size_t channel_stride, size_t at) {
    float x = rays[at], y = rays[channel_stride + at];
    float length = sqrt(FMA(x, x, FMA(y, y, 1.0f)));
    return length == length ? length : 1.0f;   // outside of the field of view it multiplies a depth of 0
}
//@ fog_length
                lens_ray_length(rays, ray_plane, (size_t)fog_y * ray_stride + fog_x)
