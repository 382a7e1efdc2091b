// World-to-camera rotation of each row of pixels, for outputs in world axes.
//@ resolve_start
    global const float *row_rotation = row_rotations + 9 * (size_t)y;
