// A response curve given as values at even steps from 0 to 1, with straight lines between them.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) {
        float step = clamp(rgb_out[3 * out + channel], 0.0f, 1.0f) * (float)(response_count - 1);
        int below = min((int)step, response_count - 2);
        rgb_out[3 * out + channel] = FMA(step - (float)below, response[below + 1] - response[below], response[below]);
    }
