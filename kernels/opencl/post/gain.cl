// Gain: amplifies the signal and its noise.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) rgb_out[3 * out + channel] *= gain;
