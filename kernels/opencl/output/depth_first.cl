// depth_first (h, w): depth [m] of the first fragment or layer behind which transmittance is at most `first_hit_transmittance`; 0 if there is
// none. The minimum over a pixel's samples.
//@ state
    vfloat depth_first, first_hit_transmittance;
//@ start
    pixel->depth_first = 0.0f;
//@ pixels_start
    for (int row = 0; row < (int)(sizeof(pixels) / sizeof(pixels[0])); row++) pixels[row].first_hit_transmittance = first_hit_transmittance;
//@ composite
    pixel->depth_first = VSELECT(pixel->depth_first, attributes->z,
                                 live & VMASK(pixel->depth_first == 0.0f) & VMASK(pixel->t - weight <= pixel->first_hit_transmittance));
//@ store
        BLOCK_STORE(pixel->depth_first, depth_first_raw + at, stride);
//@ resolve_start
    float depth_first = INFINITY;
//@ resolve_sample
            if (depth_first_raw[at] > 0.0f) depth_first = fmin(depth_first, depth_first_raw[at]);
//@ resolve_end
    depth_first_out[out] = depth_first < INFINITY ? depth_first : 0.0f;
