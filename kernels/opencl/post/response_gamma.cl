// Response curve v^(1 / gamma) on [0, 1], by exp and log: accurate to 1e-6, and much faster than pow on CPUs.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) {
        float light = clamp(rgb_out[3 * out + channel], 0.0f, 1.0f), power = FIRST_LANE(EXP(LOG((vfloat)light) * inverse_gamma));
        rgb_out[3 * out + channel] = light >= 0x1p-126f ? power : 0.0f;         // LOG is for normal numbers
    }
