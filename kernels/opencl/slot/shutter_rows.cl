// A picture of several poses seen by a pinhole is projected many times, often for a few rows: splats that lie wholly
// above or below the rows are culled by their bounding sphere, before what their true bounds take. What is drawn is the
// same: between the planes through the camera's centre and the rows, widened by the low-pass's dot, lies all of it.
// Not for boxes and the low-pass `pixel`, which grow in ways that no sphere bounds, and what stands for others, whose opacity may be
// above 1.
//@ splat_view
    if (opacities[i] <= 1.0f) {
        // the furthest that any opacity reaches, in scales and in samples
        real most = -view->log_cut, dot = sqrt(most / view->filter) + 2;
        real reach = sqrt(2 * most) * fmax(scales[2 * i], scales[2 * i + 1]), fy = view->focal_y;
        real x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
        global const real *r = view->rotation;
        real down = r[3] * x + r[4] * y + r[5] * z + view->translation[1];
        real ahead = r[6] * x + r[7] * y + r[8] * z + view->translation[2];
        real above = view->center_y + dot, below = view->center_y - view->height - dot;
        // roundings, also of float32 where there is no double; written so that a NaN culls nothing
        real slack = REAL(1e-5) * (fabs(fy * down) + (fabs(above) + fabs(below)) * fabs(ahead));
        if (fy * down + above * ahead + reach * sqrt(fy * fy + above * above) + slack < 0) return;
        if (fy * down + below * ahead - reach * sqrt(fy * fy + below * below) - slack > 0) return;
    }
