// World to camera rotation of each row of pixels, for what needs the world's axes when pixels are resolved.
//@ resolve_start
    global const float *row_rotation = turns + 9 * (size_t)y;
