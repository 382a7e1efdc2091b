// alpha (h, w): what the splats cover, 1 - transmittance.
//@ resolve_end
    alpha_out[out] = 1.0f - t;
