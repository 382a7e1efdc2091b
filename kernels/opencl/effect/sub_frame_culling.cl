// Culling by bounding sphere against a band of rows, for rolling shutters of a pinhole, which project a cloud many times for few
// rows. Conservative: the planes through the camera centre and the band's borders, moved outwards by the low-pass disc, enclose
// every visible splat. Not for boxes and the low-pass `pixel`, which no sphere bounds, nor for level-of-detail splats of
// opacity above 1.
//@ splat_view
    if (opacities[i] <= 1.0f) {
        // maximum extent at any opacity, in scales and in samples
        real most = -view->log_alpha_cutoff, disc = sqrt(most / view->sample_area) + 2;
        real reach = sqrt(2 * most) * fmax(scales[2 * i], scales[2 * i + 1]), fy = view->focal_y;
        real x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
        global const real *r = view->rotation;
        real down = r[3] * x + r[4] * y + r[5] * z + view->translation[1];
        real ahead = r[6] * x + r[7] * y + r[8] * z + view->translation[2];
        real above = view->center_y + disc, below = view->center_y - view->height - disc;
        // rounding, also in float32; a NaN is not culled
        real slack = REAL(1e-5) * (fabs(fy * down) + (fabs(above) + fabs(below)) * fabs(ahead));
        if (fy * down + above * ahead + reach * sqrt(fy * fy + above * above) + slack < 0) RETURN_CULLED;
        if (fy * down + below * ahead - reach * sqrt(fy * fy + below * below) - slack > 0) RETURN_CULLED;
    }
