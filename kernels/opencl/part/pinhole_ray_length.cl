// Length of a pinhole ray through a sample per unit of depth along z, which converts depth to distance.
//@ functions
static inline float pinhole_ray_length(float x, float y, float fx, float fy, float cx, float cy) {
    float across = (x - cx) / fx, down = (y - cy) / fy;
    return sqrt(FMA(across, across, FMA(down, down, 1.0f)));
}
//@ fog_length
                pinhole_ray_length((float)fog_x + 0.5f, (float)fog_y + 0.5f, ray_focal_x, ray_focal_y, ray_center_x, ray_center_y)
