// Shot and read noise: a value v is v * full well electrons, whose number varies by its square root, and the read-out adds its
// own. The variate of a pixel and channel is the sum of twelve uniform 16-bit numbers, in integers: mean 0 and variance 1 (as
// a normal one to 0.1 in kurtosis, none beyond 6), the same on every device. They come from a hash of where and which (pcg4d,
// Jarzynski and Olano 2020), so that nothing depends on what is drawn first.
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
