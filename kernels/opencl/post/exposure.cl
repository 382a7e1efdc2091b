// The light that the sensor gathers, times a factor.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) rgb_out[3 * out + channel] *= exposure;
