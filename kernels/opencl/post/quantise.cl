// Quantisation to the steps of the analogue-to-digital converter.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++)
        rgb_out[3 * out + channel] = rint(clamp(rgb_out[3 * out + channel], 0.0f, 1.0f) * quantise_steps) / quantise_steps;
