// Response v^(1 / gamma) of what lies in [0, 1].
//@ resolve_args
    , float inverse_gamma
//@ resolve_end
    for (int channel = 0; channel < 3; channel++)
        rgb[3 * out + channel] = pow(clamp(rgb[3 * out + channel], 0.0f, 1.0f), inverse_gamma);
