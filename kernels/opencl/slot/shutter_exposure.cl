// A picture of several poses: sub-pictures are blended one after another, and their samples gathered in the picture's.
//@ kernels
// Adds a sub-picture's light (colours and transmittances, or fog's one channel), weighted, to that of its rows.
// Index space: one work-item per sample of the sub-picture (x, y). Reads: raw. Writes: exposed.
kernel void expose(
//@@ arguments expose
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    for (int k = 0; k < channels; k++) {
        size_t at = k * (size_t)whole_channel_stride + (size_t)(top + y) * whole_stride + x;
        float before = first ? 0.0f : exposed[at];
        exposed[at] = FMA(weight, raw[k * (size_t)channel_stride + (size_t)y * stride + x], before);
    }
}

// Copies the sample buffers that are not averaged. Index space as above; 32 bits of any kind each.
kernel void expose_middle(
//@@ arguments expose_middle
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    for (int k = 0; k < channels; k++)
        exposed[k * (size_t)whole_channel_stride + (size_t)(top + y) * whole_stride + x] =
            raw[k * (size_t)channel_stride + (size_t)y * stride + x];
}
