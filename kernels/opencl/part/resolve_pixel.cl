// Resolve of a pixel (x, y) of view `view_index`: the mean of its samples, which start at `first`, over the background.
//@ resolve_pixel
    float r = 0, g = 0, b = 0, t = 0;
//@@ resolve_start
    for (int sub_y = 0; sub_y < SAMPLES; sub_y++)
        for (int sub_x = 0; sub_x < SAMPLES; sub_x++) {
            size_t at = first + (size_t)sub_y * stride + sub_x;
            r += raw[at];
            g += raw[channel_stride + at];
            b += raw[2 * (size_t)channel_stride + at];
            t += raw[3 * (size_t)channel_stride + at];
//@@ resolve_sample
        }
    const float mean = 1.0f / (SAMPLES * SAMPLES);
    t *= mean;
    size_t out = ((size_t)batch_indices[view_index] * height + y) * width + x;
    rgb_out[3 * out] = FMA(t, background_r, r * mean);
    rgb_out[3 * out + 1] = FMA(t, background_g, g * mean);
    rgb_out[3 * out + 2] = FMA(t, background_b, b * mean);
//@@ resolve_end
