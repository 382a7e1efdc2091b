// One RGB colour per splat.
//@ color_backward
    by_colors[3 * i] = (float)total.r;
    by_colors[3 * i + 1] = (float)total.g;
    by_colors[3 * i + 2] = (float)total.b;
