// World to camera rotation of each row of pixels, for what needs the world's axes when pixels are resolved.
//@ resolve_args
    , global const float *restrict turns     // (h, 3, 3)
//@ resolve_start
    global const float *turn = turns + 9 * (size_t)y;
