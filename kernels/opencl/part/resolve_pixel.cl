// Resolve of a pixel (x, y) of view `view_index`: the mean of its samples, which start at `first`, over the background.
//@ color_functions
#ifndef BASE_SAMPLE
#define BASE_SAMPLE(channel, at) raw[(channel) * (size_t)channel_stride + (at)]
#define STORE_BASE(pixel, at) PIXEL_STORE_BASE(pixel, raw, channel_stride, at)
#endif
//@ resolve_pixel
    float r = 0, g = 0, b = 0, t = 0;
//@@ resolve_start
    for (int sub_y = 0; sub_y < SAMPLES; sub_y++)
        for (int sub_x = 0; sub_x < SAMPLES; sub_x++) {
            size_t at = first + (size_t)sub_y * stride + sub_x;
            r += BASE_SAMPLE(0, at);
            g += BASE_SAMPLE(1, at);
            b += BASE_SAMPLE(2, at);
            t += BASE_SAMPLE(3, at);
//@@ resolve_sample
        }
    const float mean = 1.0f / (SAMPLES * SAMPLES);
    t *= mean;
    size_t out = ((size_t)batch_indices[view_index] * height + y) * width + x;
    rgb_out[3 * out] = FMA(t, background_r, r * mean);
    rgb_out[3 * out + 1] = FMA(t, background_g, g * mean);
    rgb_out[3 * out + 2] = FMA(t, background_b, b * mean);
//@@ resolve_end
