// Linear light of display colours by the curve of sRGB (IEC 61966-2-1), which continues above 1. EXP is for arguments up to 0.
//@ resolve_end
    for (int channel = 0; channel < 3; channel++) {
        float color = fmax(rgb_out[3 * out + channel], 0.0f);
        float exponent = FIRST_LANE(LOG((vfloat)((color + 0.055f) * (1.0f / 1.055f)))) * 2.4f;
        float power = FIRST_LANE(EXP((vfloat)(-fabs(exponent))));
        rgb_out[3 * out + channel] = color <= 0.04045f ? color * (1.0f / 12.92f) : exponent > 0.0f ? 1.0f / power : power;
    }
