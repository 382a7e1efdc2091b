// Length of the ray through a sample per unit of depth along z: what turns depths into distances. Pinhole rays.
//@ functions
static inline float ray_length(float x, float y, float fx, float fy, float cx, float cy) {
    float across = (x - cx) / fx, down = (y - cy) / fy;
    return sqrt(FMA(across, across, FMA(down, down, 1.0f)));
}
//@ resolve_args
    , float ray_fx, float ray_fy, float ray_cx, float ray_cy   // intrinsics of the sample grid
//@ resolve_sample
            float length_here = ray_length((float)(x * SAMPLES + sub_x) + 0.5f, (float)(y * SAMPLES + sub_y) + 0.5f,
                                           ray_fx, ray_fy, ray_cx, ray_cy);
