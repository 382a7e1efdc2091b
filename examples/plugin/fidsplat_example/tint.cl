// Factors of the three channels.
//@ resolve_end
    rgb_out[3 * out] *= red;
    rgb_out[3 * out + 1] *= green;
    rgb_out[3 * out + 2] *= blue;
