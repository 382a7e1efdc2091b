// Exposure of a view: a gain and an offset of each channel between the render and the loss. NumPy version: fidsplat/train/losses.py.
#define EXPOSURE_ITEMS 64

// Gains of a view from the logarithms of its exposure, and offsets.
static inline void exposure_of(global const float *exposure, float *gain, float *offset) {
    for (uint c = 0; c < 3; c++) gain[c] = exp(exposure[c]), offset[c] = exposure[3 + c];
}

// Index space: any number of work-groups of EXPOSURE_ITEMS, each with a contiguous range of pixels. Reads: the render. Writes: the exposed render.
// For CPUs; on GPUs loss_load applies the exposure.
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void apply_exposure(
//@@ arguments apply_exposure
) {
    uint groups = get_num_groups(0), piece = (pixels + groups - 1) / groups;
    uint first = get_group_id(0) * piece, end = min(first + piece, pixels);
    float gain[3], offset[3];
    exposure_of(exposures + 6 * view_index, gain, offset);
    for (uint i = first + get_local_id(0); i < end; i += EXPOSURE_ITEMS)
        for (uint c = 0; c < 3; c++) rgb[3 * (size_t)i + c] = gain[c] * rendered[3 * (size_t)i + c] + offset[c];
}

// Index space: as of apply_exposure. Reads: the render. Updates: grad_rgb, from
// the gradient with respect to the exposed render to the gradient with respect to the render. Writes: sums per work-group of the gradients with
// respect to the gains' logarithms and the offsets, in a fixed order (deterministic).
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void exposure_backward(
//@@ arguments exposure_backward
) {
    local real partial[6][EXPOSURE_ITEMS];
    uint item = get_local_id(0), groups = get_num_groups(0), piece = (pixels + groups - 1) / groups;
    uint first = get_group_id(0) * piece, end = min(first + piece, pixels);
    float gain[3], offset[3];
    exposure_of(exposures + 6 * view_index, gain, offset);
    real sums[6] = {0};
    for (uint i = first + item; i < end; i += EXPOSURE_ITEMS)
        for (uint c = 0; c < 3; c++) {
            float slope = grad_rgb[3 * (size_t)i + c];
            if (slope == 0.0f) continue;       // outside of the mask the render may not be finite
            sums[c] += slope * gain[c] * rendered[3 * (size_t)i + c];
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
