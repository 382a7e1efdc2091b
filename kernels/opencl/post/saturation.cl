// Saturation of the sensor's pixels.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) rgb_out[3 * out + channel] = fmin(rgb_out[3 * out + channel], saturation);
