// Vignetting: factor max(1 + a r^2 + b r^4 + c r^6, 0) around the principal point, r = 1 at half of the image diagonal.
//@ resolve_end
    float vignette_dx = ((float)x + 0.5f - vignette_x) * vignette_scale, vignette_dy = ((float)y + 0.5f - vignette_y) * vignette_scale;
    float vignette_r2 = FMA(vignette_dx, vignette_dx, vignette_dy * vignette_dy);
    float fall_off = FMA(vignette_r2, FMA(vignette_r2, FMA(vignette_r2, vignette_c, vignette_b), vignette_a), 1.0f);
    for (int channel = 0; channel < 3; channel++) rgb_out[3 * out + channel] *= fmax(fall_off, 0.0f);
