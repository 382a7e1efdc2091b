// Homogeneous fog: light from distance r along the ray is attenuated by exp(-density r) and mixed with the fog's colour, per
// fragment and layer. The fog's colour is the background.
//@ state
    vfloat fog_slope;       // -density, per metre of depth
    vfloat fogged;          // sum of weights times absorbed fraction
//@ start
    pixel->fogged = 0.0f;
//@ pixels_start
    for (int row = 0; row < (int)(sizeof(pixels) / sizeof(pixels[0])); row++)
        for (int lane = 0; lane < LANES; lane++) {
#if LANES == 1
            int fog_x = px, fog_y = py + row;
            pixels[row].fog_slope
#else
            int fog_x = x0 + LANE_X(row, lane), fog_y = y0 + LANE_Y(row, lane);
            ((float *)&pixels[row].fog_slope)[lane]
#endif
                = -fog_density *
//@@ fog_length
                ;
        }
//@ composite
    vfloat absorbed = weight * (1.0f - EXP(pixel->fog_slope * attributes->z));
    pixel->r = FMA(-absorbed, attributes->r, pixel->r);
    pixel->g = FMA(-absorbed, attributes->g, pixel->g);
    pixel->b = FMA(-absorbed, attributes->b, pixel->b);
    pixel->fogged += absorbed;
//@ store
        BLOCK_STORE(pixel->fogged, fog_raw + at, stride);
//@ resolve_start
    float fogged = 0;
//@ resolve_sample
            fogged += fog_raw[at];
//@ resolve_end
    fogged *= mean;
    rgb_out[3 * out] = FMA(fogged, background_r, rgb_out[3 * out]);
    rgb_out[3 * out + 1] = FMA(fogged, background_g, rgb_out[3 * out + 1]);
    rgb_out[3 * out + 2] = FMA(fogged, background_b, rgb_out[3 * out + 2]);
