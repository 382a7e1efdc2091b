// The length of each sample's ray while pixels are resolved.
//@ resolve_sample
            float length_here = ray_length((float)(x * SAMPLES + sub_x) + 0.5f, (float)(y * SAMPLES + sub_y) + 0.5f,
                                           ray_fx, ray_fy, ray_cx, ray_cy);
