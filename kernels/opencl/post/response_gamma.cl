// Response v^(1 / gamma) of what lies in [0, 1]. By exp and log, which are right to 1e-6 here and which CPUs do much faster than pow.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++)
        rgb_out[3 * out + channel] = exp(inverse_gamma * log(clamp(rgb_out[3 * out + channel], 0.0f, 1.0f)));
