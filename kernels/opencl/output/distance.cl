// distance (h, w): expected distance along the ray [m], sum w r / sum w; 0 where alpha is below 1/255.
//@ resolve_start
    float along_ray = 0;
//@ resolve_sample
            along_ray = FMA(depth_raw[at], length_here, along_ray);
//@ resolve_end
    distance_out[out] = depth_weight > 0 ? along_ray / depth_weight : 0.0f;
