// White balance: a factor for each channel.
//@ resolve_end
    rgb_out[3 * out] *= balance_r;
    rgb_out[3 * out + 1] *= balance_g;
    rgb_out[3 * out + 2] *= balance_b;
