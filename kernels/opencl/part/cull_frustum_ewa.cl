// Frustum culling where all splats are 3D Gaussians with EWA projection (ellipsoids_only). The Jacobian at a centre is at most
// focal_x / z times 1 + the clamped slope. Widening by 0.3 square pixels is within `margin`.
//@ max_scale
    max_scale = fmax(max_scale, (real)thickness[i]);
//@ cull_frustum
    real most = sqrt((float)(REAL(-2.0) * view->log_alpha_cutoff));
    real margin = most * SAMPLES + 4, sphere = REAL(1.001) * most * fmax(max_scale, (real)MIN_SCALE);    // for rounding
    real wide_x = sphere * view->focal_x * (1 + fmax(fabs(view->ewa_clamp[0]), fabs(view->ewa_clamp[1])));
    real wide_y = sphere * view->focal_y * (1 + fmax(fabs(view->ewa_clamp[2]), fabs(view->ewa_clamp[3])));
    wide_x += extent * (view->focal_x + fabs(view->center_x) + view->width + margin);
    wide_y += extent * (view->focal_y + fabs(view->center_y) + view->height + margin);
    real to_x = view->focal_x * p.x, to_y = view->focal_y * p.y;
    // a NaN is not culled
    if (p.z + extent < view->near || to_x + (view->center_x + margin) * p.z < -wide_x
        || to_x + (view->center_x - view->width - margin) * p.z > wide_x || to_y + (view->center_y + margin) * p.z < -wide_y
        || to_y + (view->center_y - view->height - margin) * p.z > wide_y) return CULLED;
