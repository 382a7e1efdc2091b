// alpha (h, w): what the splats cover, 1 - transmittance.
//@ resolve_args
    , global float *restrict alpha_out
//@ resolve_end
    alpha_out[out] = 1.0f - t;
