// Exposure: scales the light.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) rgb_out[3 * out + channel] *= exposure;
