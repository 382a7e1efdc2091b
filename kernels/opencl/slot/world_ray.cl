// Direction of the ray through a pixel's centre in the world, not of unit length.
//@ world_ray
    float ray_x = (((float)x + 0.5f) * SAMPLES - ray_cx) / ray_fx, ray_y = (((float)y + 0.5f) * SAMPLES - ray_cy) / ray_fy;
    float world_x = FMA(turn_00, ray_x, FMA(turn_10, ray_y, turn_20));
    float world_y = FMA(turn_01, ray_x, FMA(turn_11, ray_y, turn_21));
    float world_z = FMA(turn_02, ray_x, FMA(turn_12, ray_y, turn_22));
