// alpha (h, w): coverage, 1 - transmittance.
//@ resolve_end
    alpha_out[out] = 1.0f - t;
