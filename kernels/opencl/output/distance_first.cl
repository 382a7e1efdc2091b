// distance_first (h, w): distance along the ray [m] of depth_first; the minimum over a pixel's samples.
//@ resolve_start
    float first_along = INFINITY;
//@ resolve_sample
            if (depth_first_raw[at] > 0.0f) first_along = fmin(first_along, depth_first_raw[at] * length_here);
//@ resolve_end
    distance_first_out[out] = first_along < INFINITY ? first_along : 0.0f;
