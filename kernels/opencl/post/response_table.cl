// Response curve from a table at even steps of [0, 1], with linear interpolation.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) {
        float step = clamp(rgb_out[3 * out + channel], 0.0f, 1.0f) * (float)(response_count - 1);
        int below = min((int)step, response_count - 2);
        rgb_out[3 * out + channel] = FMA(step - (float)below, response[below + 1] - response[below], response[below]);
    }
