// Amplification of what the sensor read, its noise included.
//@ resolve_args
    , float gain
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) rgb[3 * out + channel] *= gain;
