// Fog of even density: of what is seen at distance r along the ray exp(-density r) is left, the rest is the fog's colour. Exact for
// each fragment and layer, as each is composited with its own distance. Behind everything is fog alone: its colour is the background.
//@ state
    vfloat fog_slope;       // -density, per metre of depth
    vfloat fogged;          // sum of weights times what the fog hides
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
    vfloat absorbed = weight * (1.0f - exp(pixel->fog_slope * attributes->z));
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
