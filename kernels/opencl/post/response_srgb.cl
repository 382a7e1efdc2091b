// sRGB response curve (IEC 61966-2-1) on [0, 1]; the power by exp and log, as in response_gamma.cl.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) {
        float light = clamp(rgb_out[3 * out + channel], 0.0f, 1.0f), power = FIRST_LANE(EXP(LOG((vfloat)light) * (1.0f / 2.4f)));
        rgb_out[3 * out + channel] = light <= 0.0031308f ? 12.92f * light : FMA(1.055f, power, -0.055f);
    }
