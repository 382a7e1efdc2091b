// Index space: one work-item per pixel of the image (x, y) and view.
// Reads:  raw (4 channels) and the outputs' samples. Writes: rgb (h, w, 3) and the requested outputs.
kernel void resolve(
//@@ arguments resolve
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    uint view_index = get_global_id(2);
    // after the samples of the preceding views
    size_t first = view_index * (channel_stride / get_global_size(2)) + (size_t)(y * SAMPLES) * stride + x * SAMPLES;
//@@ resolve_pixel
}
//@@ kernels
