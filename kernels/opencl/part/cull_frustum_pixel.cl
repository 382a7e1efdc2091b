// Frustum culling under the low-pass `pixel`, which widens a disk by the footprint of a sample on the disk's plane, also in depth. A disk and
// a margin that are larger by 1 / sqrt(1 - (R k)^2), with R the cut-off radius and k = 1/8, contain the widened disk
// (fidsplat/streaming/frustum_culling.py has the proof). Splats outside of the band of rows are culled too.
//@ cull_frustum
    real most = sqrt((float)(REAL(-2.0) * view->log_alpha_cutoff));
    real deep = REAL(0.126) * most, larger = deep < 1 ? most / sqrt(1 - deep * deep) : INFINITY;
    real margin = REAL(0.5) * larger + 4, sphere = extent + REAL(1.001) * larger * fmax(max_scale, (real)MIN_SCALE);    // for rounding
    real left = view->center_x + margin, right = view->center_x - view->width - margin;
    real above = view->center_y + margin, below = view->center_y - view->height - margin;
    real above_band = above - view->first_row, below_band = view->center_y - view->end_row - margin;
    real to_x = view->focal_x * p.x, to_y = view->focal_y * p.y;
    // |n_x| + |n_z| >= |n|; a NaN is not culled
    if (to_x + left * p.z < -sphere * (view->focal_x + fabs(left)) || to_x + right * p.z > sphere * (view->focal_x + fabs(right))
        || to_y + above * p.z < -sphere * (view->focal_y + fabs(above))
        || to_y + below * p.z > sphere * (view->focal_y + fabs(below))) return CULLED;
    // not for a complete image, whose last row of tiles may reach below it
    if ((view->first_row > 0 && to_y + above_band * p.z < -sphere * (view->focal_y + fabs(above_band)))
        || (view->end_row < view->height && to_y + below_band * p.z > sphere * (view->focal_y + fabs(below_band)))) return OUT_OF_BAND;
