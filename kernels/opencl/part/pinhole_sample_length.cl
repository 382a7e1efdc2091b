// Length of each sample's ray, during resolve.
//@ resolve_sample
            float length_here = pinhole_ray_length((float)(x * SAMPLES + sub_x) + 0.5f, (float)(y * SAMPLES + sub_y) + 0.5f,
                                           ray_focal_x, ray_focal_y, ray_center_x, ray_center_y);
