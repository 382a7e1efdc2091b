// Exposure of a view: a gain and an offset of each channel between the render and the loss; on GPUs in loss.cl. NumPy version: fidsplat/train/losses.py.
#define EXPOSURE_ITEMS 96   // a multiple of three: each work-item has the values of one channel

// Declares channel, gain and offset of a work-item, and the values of its work-group, a contiguous range of pixels.
#define EXPOSED_RANGE \
    uint item = get_local_id(0), channel = item % 3, piece = 3 * ((pixels + get_num_groups(0) - 1) / get_num_groups(0)); \
    uint first = get_group_id(0) * piece, end = min(first + piece, 3 * pixels); \
    float gain = exp(exposures[6 * view_index + channel]), offset = exposures[6 * view_index + 3 + channel]

// Index space: any number of work-groups of EXPOSURE_ITEMS. Reads: the render. Writes: the exposed render.
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void apply_exposure(
//@@ arguments apply_exposure
) {
    EXPOSED_RANGE;
    for (uint k = first + item; k < end; k += EXPOSURE_ITEMS) rgb[k] = gain * rendered[k] + offset;
}

// Index space: as of apply_exposure. Reads: the render. Updates: grad_rgb, from the gradient with respect to the exposed render to the gradient with
// respect to the render. Writes: sums per work-group of the gradients with respect to the gains' logarithms and the offsets, in a fixed order
// (deterministic).
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void exposure_backward(
//@@ arguments exposure_backward
) {
    local real partial[2][EXPOSURE_ITEMS];
    EXPOSED_RANGE;
    real by_gain = 0, by_offset = 0;
    for (uint k = first + item; k < end; k += EXPOSURE_ITEMS) {
        float slope = grad_rgb[k], value = slope == 0.0f ? 0.0f : rendered[k];   // outside of the mask the render may not be finite
        by_gain += slope * gain * value;
        by_offset += slope;
        grad_rgb[k] = slope * gain;
    }
    partial[0][item] = by_gain;
    partial[1][item] = by_offset;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 6) {
        real sum = 0;
        for (uint other = channel; other < EXPOSURE_ITEMS; other += 3) sum += partial[item / 3][other];
        exposure_sums[6 * get_group_id(0) + item] = (float)sum;
    }
}

// Index space: one work-item for each of the six numbers of an exposure. Updates: the exposures, to a mean of 0 over the views; the splats' colours then
// compensate.
kernel void centre_exposures(
//@@ arguments centre_exposures
) {
    uint k = get_global_id(0);
    real mean = 0;
    for (uint i = 0; i < count; i++) mean += exposures[6 * i + k];
    mean /= count;
    for (uint i = 0; i < count; i++) exposures[6 * i + k] -= (float)mean;
}
