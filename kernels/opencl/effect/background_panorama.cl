// Background from an equirectangular panorama: the middle column is +z, to its right is +x, the top row is -y. Bilinear, also across
// the seam.
//@ functions
static inline float panorama_at(global const float *restrict panorama, int width, int height, int x, int y, int channel) {
    x = x < 0 ? x + width : (x >= width ? x - width : x);
    y = clamp(y, 0, height - 1);
    return panorama[((size_t)y * width + x) * 3 + channel];
}
//@ background
    float longitude_share = FMA(atan2(world_x, world_z), 0.15915494309189535f, 0.5f);
    float latitude_share = FMA(atan2(world_y, sqrt(FMA(world_x, world_x, world_z * world_z))), 0.31830988618379067f, 0.5f);
    float panorama_x = FMA(longitude_share, (float)panorama_width, -0.5f);
    float panorama_y = FMA(latitude_share, (float)panorama_height, -0.5f);
    int left = (int)floor(panorama_x), top = (int)floor(panorama_y);
    float right_share = panorama_x - (float)left, bottom_share = panorama_y - (float)top;
    for (int channel = 0; channel < 3; channel++) {
        float corner[4];
        for (int k = 0; k < 4; k++)
            corner[k] = panorama_at(panorama, panorama_width, panorama_height, left + (k & 1), top + (k >> 1), channel);
        float above = FMA(right_share, corner[1] - corner[0], corner[0]);
        float below = FMA(right_share, corner[3] - corner[2], corner[2]);
        behind[channel] = FMA(bottom_share, below - above, above);
    }
