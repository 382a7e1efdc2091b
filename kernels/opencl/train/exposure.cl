// Exposure of a view: a gain and an offset of each channel between the render and the loss. NumPy version: fidsplat/train/losses.py.
#define EXPOSURE_ITEMS 64

// Index space: one work-item per pixel. Reads: the render. Writes: the exposed render.
kernel void apply_exposure(
//@@ arguments apply_exposure
) {
    uint i = get_global_id(0);
    if (i >= count) return;
    float3 gain = {gain_red, gain_green, gain_blue}, offset = {offset_red, offset_green, offset_blue};
    vstore3(gain * vload3(i, rgb) + offset, i, exposed);
}

// Index space: any number of work-groups of EXPOSURE_ITEMS, each with a contiguous range of pixels. Reads: the render. Updates: grad_rgb, from
// the gradient with respect to the exposed render to the gradient with respect to the render. Writes: sums per work-group of the gradients with
// respect to the gains' logarithms and the offsets, in a fixed order (deterministic).
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void exposure_backward(
//@@ arguments exposure_backward
) {
    local real partial[6][EXPOSURE_ITEMS];
    uint item = get_local_id(0), groups = get_num_groups(0), piece = (count + groups - 1) / groups;
    uint first = get_group_id(0) * piece, end = min(first + piece, count);
    float gain[3] = {gain_red, gain_green, gain_blue};
    real sums[6] = {0};
    for (uint i = first + item; i < end; i += EXPOSURE_ITEMS)
        for (uint c = 0; c < 3; c++) {
            float slope = grad_rgb[3 * (size_t)i + c];
            if (slope == 0.0f) continue;       // outside of the mask the render may not be finite
            sums[c] += slope * gain[c] * rgb[3 * (size_t)i + c];
            sums[3 + c] += slope;
            grad_rgb[3 * (size_t)i + c] = slope * gain[c];
        }
    for (uint k = 0; k < 6; k++) partial[k][item] = sums[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 6) {
        real sum = 0;
        for (uint other = 0; other < EXPOSURE_ITEMS; other++) sum += partial[item][other];
        exposure_sums[6 * get_group_id(0) + item] = (float)sum;
    }
}
