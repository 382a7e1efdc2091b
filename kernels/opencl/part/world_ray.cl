// Background by direction (gradient, panorama): composited behind the samples of one pose before resolve. Lenses have one ray per
// sample (part/rays.cl); others have (x, y, 1), or parallel rays for an infinite focal length.
//@ kernels
// Index space: one work-item per sample (x, y). Reads: raw's transmittances. Writes: raw's colours.
kernel void composite_background(
//@@ arguments composite_background
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    size_t at = (size_t)y * stride + x;
    float ray_x = ((float)x + 0.5f - ray_center_x) / ray_focal_x;
    float ray_y = ((float)y + 0.5f - ray_center_y) / ray_focal_y, ray_z = 1.0f;
//@@ background_ray
    global const real *r = view->rotation;
    float world_x = FMA((float)r[0], ray_x, FMA((float)r[3], ray_y, (float)r[6] * ray_z));
    float world_y = FMA((float)r[1], ray_x, FMA((float)r[4], ray_y, (float)r[7] * ray_z));
    float world_z = FMA((float)r[2], ray_x, FMA((float)r[5], ray_y, (float)r[8] * ray_z));
    float behind[3];
//@@ background
    float transmittance = raw[3 * (size_t)channel_stride + at];
    for (int channel = 0; channel < 3; channel++)
        raw[channel * (size_t)channel_stride + at] = FMA(transmittance, behind[channel], raw[channel * (size_t)channel_stride + at]);
}
