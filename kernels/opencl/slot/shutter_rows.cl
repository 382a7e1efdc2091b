// A picture of several poses seen by a pinhole is projected many times, often for a few rows: splats that lie wholly
// above or below the rows are culled by their bounding sphere, before what their true bounds take. What is drawn is the
// same: between the planes through the camera's centre and the rows, widened by the low-pass's dot, lies all of it.
// Not for boxes and the low-pass `pixel`, which grow in ways that no sphere bounds.
//@ splat_view
    {
        // the furthest that any opacity reaches, in scales and in samples
        real most = -view[VIEW_LOG_CUT], dot = sqrt(most / view[VIEW_FILTER]) + 2;
        real reach = sqrt(2 * most) * fmax(scales[2 * i], scales[2 * i + 1]), fy = view[VIEW_FY];
        real x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
        real down = view[3] * x + view[4] * y + view[5] * z + view[VIEW_T + 1];
        real ahead = view[6] * x + view[7] * y + view[8] * z + view[VIEW_T + 2];
        real above = view[VIEW_CY] + dot, below = view[VIEW_CY] - view[VIEW_HEIGHT] - dot;
        // roundings, also of float32 where there is no double; written so that a NaN culls nothing
        real slack = REAL(1e-5) * (fabs(fy * down) + (fabs(above) + fabs(below)) * fabs(ahead));
        if (fy * down + above * ahead + reach * sqrt(fy * fy + above * above) + slack < 0) return;
        if (fy * down + below * ahead - reach * sqrt(fy * fy + below * below) - slack > 0) return;
    }
