// Exposure of several poses: sub-frames are blended one after another, and their samples accumulated.
//@ kernels
// Accumulates a sub-frame's samples (colours and transmittance, or the fog channel), weighted, in its rows.
// Index space: one work-item per sample of the sub-frame (x, y). Reads: raw. Writes: accumulated.
kernel void accumulate(
//@@ arguments accumulate
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    for (int k = 0; k < channels; k++) {
        size_t at = k * (size_t)frame_channel_stride + (size_t)(top + y) * frame_stride + x;
        float before = first ? 0.0f : accumulated[at];
        accumulated[at] = FMA(weight, raw[k * (size_t)channel_stride + (size_t)y * stride + x], before);
    }
}

// Copies sample buffers that are not averaged, of any 32-bit type. Index space as above.
kernel void copy_middle(
//@@ arguments copy_middle
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    for (int k = 0; k < channels; k++)
        accumulated[k * (size_t)frame_channel_stride + (size_t)(top + y) * frame_stride + x] =
            raw[k * (size_t)channel_stride + (size_t)y * stride + x];
}
