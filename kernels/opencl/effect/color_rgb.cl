// One RGB colour per splat.
//@ color
    record.r = colors[3 * i];
    record.g = colors[3 * i + 1];
    record.b = colors[3 * i + 2];
