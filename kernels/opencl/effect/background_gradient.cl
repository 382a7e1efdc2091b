// Background gradient: two colours blended by the sine of the ray's elevation.
//@ background
    float sine_elevation = FMA(world_x, up_x, FMA(world_y, up_y, world_z * up_z))
                   / sqrt(FMA(world_x, world_x, FMA(world_y, world_y, world_z * world_z)));
    float sky_share = clamp(FMA(0.5f, sine_elevation, 0.5f), 0.0f, 1.0f);
    behind[0] = FMA(sky_share, sky_r - ground_r, ground_r);
    behind[1] = FMA(sky_share, sky_g - ground_g, ground_g);
    behind[2] = FMA(sky_share, sky_b - ground_b, ground_b);
