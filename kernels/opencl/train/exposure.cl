// Exposure of a view: a gain and an offset of each channel between the render and the loss. NumPy version: fidsplat/train/losses.py.
#define EXPOSURE_ITEMS 64

// Gains of a view from the logarithms of its exposure, and offsets.
static inline void exposure_of(global const real *exposure, float *gain, float *offset) {
    for (uint c = 0; c < 3; c++) gain[c] = (float)exp(exposure[c]), offset[c] = (float)exposure[3 + c];
}

// Index space: any number of work-groups of EXPOSURE_ITEMS, each with a contiguous range of pixels. Reads: the render. Writes: the exposed render.
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void apply_exposure(
//@@ arguments apply_exposure
) {
    uint groups = get_num_groups(0), piece = (count + groups - 1) / groups;
    uint first = get_group_id(0) * piece, end = min(first + piece, count);
    float gain[3], offset[3];
    exposure_of(exposures + 6 * row, gain, offset);
    for (uint i = first + get_local_id(0); i < end; i += EXPOSURE_ITEMS)
        for (uint c = 0; c < 3; c++) exposed[3 * (size_t)i + c] = gain[c] * rgb[3 * (size_t)i + c] + offset[c];
}

// Index space: as of apply_exposure. Reads: the render. Updates: grad_rgb, from
// the gradient with respect to the exposed render to the gradient with respect to the render. Writes: sums per work-group of the gradients with
// respect to the gains' logarithms and the offsets, in a fixed order (deterministic).
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void exposure_backward(
//@@ arguments exposure_backward
) {
    local real partial[6][EXPOSURE_ITEMS];
    uint item = get_local_id(0), groups = get_num_groups(0), piece = (count + groups - 1) / groups;
    uint first = get_group_id(0) * piece, end = min(first + piece, count);
    float gain[3], offset[3];
    exposure_of(exposures + 6 * row, gain, offset);
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
        exposure_sums[6 * get_group_id(0) + item] = sum;
    }
}

// Index space: one work-group of EXPOSURE_ITEMS. Reads: the sums of `groups` work-groups of exposure_backward. Updates: the exposure of a view, and its
// moments.
kernel __attribute__((reqd_work_group_size(EXPOSURE_ITEMS, 1, 1))) void refine_exposure(
//@@ arguments refine_exposure
) {
    local real total[6];
    real gradient[6], direction[6];
    uint item = get_local_id(0);
    if (item < 6) {
        real sum = 0;
        for (uint group = 0; group < groups; group++) sum += exposure_sums[6 * group + item];
        total[item] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item > 0) return;
    for (uint k = 0; k < 6; k++) gradient[k] = total[k];
    view_adam(gradient, 3, exposure_moments + 12 * row, beta1, beta2, correction1, correction2, direction);
    for (uint k = 0; k < 6; k++) exposures[6 * row + k] += rate * direction[k];
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
    for (uint i = 0; i < count; i++) exposures[6 * i + k] -= mean;
}
