// depth (h, w): expected depth [m] along z (fisheye, panorama: along the ray), sum w z / sum w; 0 where alpha is below 1/255.
//@ state
    vfloat depth, depth_weight;
//@ start
    pixel->depth = 0.0f;
    pixel->depth_weight = 0.0f;
//@ composite
    pixel->depth = FMA(weight, attributes->z, pixel->depth);
    pixel->depth_weight += weight;
//@ store
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->depth, pixel_covered(pixel)), depth_raw + at, stride);
        BLOCK_STORE(VSELECT((vfloat)0.0f, pixel->depth_weight, pixel_covered(pixel)), depth_raw + channel_stride + at, stride);
//@ resolve_start
    float depth = 0, depth_weight = 0;
//@ resolve_sample
            depth += depth_raw[at];
            depth_weight += depth_raw[channel_stride + at];
//@ resolve_end
    depth_out[out] = depth_weight > 0 ? depth / depth_weight : 0.0f;
