// One RGB colour per splat, held in half precision.
//@ project_args
    , global const half *restrict colors_half   // (n, 3)
//@ color
    record.r = vload_half(3 * (size_t)i, colors_half);
    record.g = vload_half(3 * (size_t)i + 1, colors_half);
    record.b = vload_half(3 * (size_t)i + 2, colors_half);
