// One RGB colour per splat.
//@ project_args
    , global const float *restrict colors   // (n, 3)
//@ color
    record.r = colors[3 * i];
    record.g = colors[3 * i + 1];
    record.b = colors[3 * i + 2];
