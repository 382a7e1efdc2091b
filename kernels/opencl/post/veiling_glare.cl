// Veiling glare: a share of the light is scattered evenly over the image.
//@ resolve_end
    rgb_out[3 * out] = FMA(rgb_out[3 * out], glare_rest, glare_r);
    rgb_out[3 * out + 1] = FMA(rgb_out[3 * out + 1], glare_rest, glare_g);
    rgb_out[3 * out + 2] = FMA(rgb_out[3 * out + 2], glare_rest, glare_b);
