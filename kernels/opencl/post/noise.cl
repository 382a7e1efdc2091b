// Shot noise and read noise. A value v is v * full well electrons, with variance equal to their number, plus the variance of the
// readout. The normal variate of a pixel and channel is a sum of twelve uniform 16-bit integers: mean 0, variance 1, kurtosis
// 0.1 below normal, at most 6 in magnitude, and equal on every device. The integers are a hash of pixel, channel and seed
// (pcg4d, Jarzynski and Olano 2020), so they do not depend on the order of pixels.
//@ functions
static inline uint4 pcg4d(uint4 v) {
    v = v * 1664525u + 1013904223u;
    v.x += v.y * v.w; v.y += v.z * v.x; v.z += v.x * v.y; v.w += v.y * v.z;
    v ^= v >> 16u;
    v.x += v.y * v.w; v.y += v.z * v.x; v.z += v.x * v.y; v.w += v.y * v.z;
    return v;
}

static inline float normal_variate(uint x, uint y, uint channel, uint seed) {
    uint4 first = pcg4d((uint4)(x, y, 2u * channel, seed)), second = pcg4d((uint4)(x, y, 2u * channel + 1u, seed));
    uint sum = (first.x & 0xFFFFu) + (first.x >> 16) + (first.y & 0xFFFFu) + (first.y >> 16) + (first.z & 0xFFFFu) + (first.z >> 16)
               + (first.w & 0xFFFFu) + (first.w >> 16) + (second.x & 0xFFFFu) + (second.x >> 16) + (second.y & 0xFFFFu) + (second.y >> 16);
    return (float)((int)sum - 393210) * (1.0f / 65536.0f);
}
//@ resolve_end
    for (uint channel = 0; channel < 3; channel++) {
        float light = rgb_out[3 * out + channel];
        float deviation = sqrt(FMA(fmax(light, 0.0f), shot_variance, read_variance));
        rgb_out[3 * out + channel] = FMA(deviation, normal_variate((uint)x, (uint)y, channel, noise_seed), light);
    }
