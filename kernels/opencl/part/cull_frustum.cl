// Frustum culling by bounding spheres, before the exact bounds: of splats on CPUs, and of groups in large clouds on GPUs
// (unculled_splats.cl). The frustum's side planes are moved outwards by `margin` samples, the reach of the low-pass and the padding
// of bounds. Not for boxes: edges that meet at a sharp angle are filtered far beyond their corner.
//@ cull_frustum
    real most = sqrt((float)(REAL(-2.0) * view->log_alpha_cutoff));
    real margin = most * SAMPLES + 4, sphere = extent + REAL(1.001) * most * fmax(max_scale, (real)MIN_SCALE);    // for rounding
    real left = view->center_x + margin, right = view->center_x - view->width - margin;
    real above = view->center_y + margin, below = view->center_y - view->height - margin;
    real to_x = view->focal_x * p.x, to_y = view->focal_y * p.y;
    // |n_x| + |n_z| >= |n|; a NaN is not culled
    if (to_x + left * p.z < -sphere * (view->focal_x + fabs(left)) || to_x + right * p.z > sphere * (view->focal_x + fabs(right))
        || to_y + above * p.z < -sphere * (view->focal_y + fabs(above))
        || to_y + below * p.z > sphere * (view->focal_y + fabs(below))) return CULLED;
