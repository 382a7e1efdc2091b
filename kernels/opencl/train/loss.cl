// Training loss for GPUs (loss_values.cl): each kernel is a pass over all pixels. A work-item computes LANES values of a row.

// Rows per work-item in the passes over columns; the rows share their reads.
#define ROWS_PER_ITEM 4

// Declares a work-item's position in an image, `rows` rows of LANES values; returns outside of the image.
#define LOCATE(rows) \
    int column = get_global_id(0) * LANES, row = get_global_id(1) * (rows); \
    if (column >= width || row >= height) return; \
    size_t at = (size_t)(row + MARGIN_ROWS) * stride + MARGIN + column

// Gain of a channel.
#define GAIN(channel) exp(exposures[6 * view_index + (channel)])

// Index space: one work-item per value of the image. Reads: the render, to which an exposure is applied if `exposed`, the target, the mask. Writes: images
// 0 and 1 of `images`. Where the mask is 0 the render is replaced by the target.
kernel void loss_load(
//@@ arguments loss_load
) {
    int column = get_global_id(0), row = get_global_id(1);
    if (column >= width || row >= height) return;
    size_t from = (size_t)row * width + column, to = (size_t)(row + MARGIN_ROWS) * stride + MARGIN + column;
    float target_value = target[from] * (1.0f / 255);
    bool counts = !masked || mask[(size_t)row * (width / 3) + column / 3];
    float value = rgb[from];
    if (exposed) value = GAIN(column % 3) * value + exposures[6 * view_index + 3 + column % 3];
    images[to] = counts ? value : target_value;
    images[image_stride + to] = target_value;
}

// Index space: (LANES values, rows). Reads: images 0 and 1 (a and b). Writes: images 2 to 6, the row-wise means of a, b, a a, b b,
// a b.
kernel void loss_rows(
//@@ arguments loss_rows
) {
    LOCATE(1);
    vfloat a = 0, b = 0, aa = 0, bb = 0, ab = 0;
    for (int k = -RADIUS; k <= RADIUS; k++) {
        vfloat x = VLOAD(images + at + 3 * k), y = VLOAD(images + image_stride + at + 3 * k), w = WINDOW[k + RADIUS];
        a += w * x;
        b += w * y;
        aa += w * (x * x);
        bb += w * (y * y);
        ab += w * (x * y);
    }
    VSTORE(INSIDE(a), images + 2 * image_stride + at);
    VSTORE(INSIDE(b), images + 3 * image_stride + at);
    VSTORE(INSIDE(aa), images + 4 * image_stride + at);
    VSTORE(INSIDE(bb), images + 5 * image_stride + at);
    VSTORE(INSIDE(ab), images + 6 * image_stride + at);
}

// Column-wise means of `count` images from `from` on, for ROWS_PER_ITEM rows. Rows below the last margin, which are in the
// next image of the buffer, only affect results outside of the image.
static inline void columns_of(global const float *from, int count, int stride, uint image_stride, vfloat means[][5]) {
    for (int row_offset = 0; row_offset < ROWS_PER_ITEM; row_offset++)
        for (int image = 0; image < count; image++) means[row_offset][image] = 0;
#pragma unroll
    for (int k = -RADIUS; k < RADIUS + ROWS_PER_ITEM; k++)
#pragma unroll
        for (int image = 0; image < count; image++) {
            vfloat value = VLOAD(from + image * (size_t)image_stride + k * stride);
#pragma unroll
            for (int row_offset = 0; row_offset < ROWS_PER_ITEM; row_offset++)
                if (k - row_offset >= -RADIUS && k - row_offset <= RADIUS) means[row_offset][image] += WINDOW[k - row_offset + RADIUS] * value;
        }
}

// Index space: (LANES values, ROWS_PER_ITEM rows). Reads: images 2 to 6. Writes: images 7 to 9, the gradients of the SSIM with respect to the means of
// a, a a and a b; image 10, the SSIM.
kernel void loss_columns(
//@@ arguments loss_columns
) {
    LOCATE(ROWS_PER_ITEM);
    vfloat column_means[ROWS_PER_ITEM][5];
    columns_of(images + 2 * image_stride + at, 5, stride, image_stride, column_means);
    for (int row_offset = 0; row_offset < ROWS_PER_ITEM && row + row_offset < height; row_offset++, at += stride) {
        vfloat a = column_means[row_offset][0], b = column_means[row_offset][1], aa = column_means[row_offset][2];
        vfloat bb = column_means[row_offset][3], ab = column_means[row_offset][4];
        const Ssim here = ssim_of(a, b, aa, bb, ab);
        VSTORE(INSIDE(here.grad_mean), images + 7 * image_stride + at);
        VSTORE(INSIDE(here.grad_variance), images + 8 * image_stride + at);
        VSTORE(INSIDE(here.grad_shared), images + 9 * image_stride + at);
        VSTORE(INSIDE(here.ssim), images + 10 * image_stride + at);
    }
}

// Index space: (LANES values, rows). Reads: images 7 to 9. Writes: images 2 to 4, their row-wise means.
kernel void loss_rows_backward(
//@@ arguments loss_rows_backward
) {
    LOCATE(1);
    vfloat grad_mean = 0, grad_variance = 0, grad_shared = 0;
    for (int k = -RADIUS; k <= RADIUS; k++) {
        global const float *from = images + 7 * image_stride + at + 3 * k;
        vfloat w = WINDOW[k + RADIUS];
        grad_mean += w * VLOAD(from);
        grad_variance += w * VLOAD(from + image_stride);
        grad_shared += w * VLOAD(from + 2 * image_stride);
    }
    VSTORE(INSIDE(grad_mean), images + 2 * image_stride + at);
    VSTORE(INSIDE(grad_variance), images + 3 * image_stride + at);
    VSTORE(INSIDE(grad_shared), images + 4 * image_stride + at);
}

// Index space: (LANES values, ROWS_PER_ITEM rows). Reads: images 0 to 4. Writes: the gradient of the loss with respect to the render, in the shape of
// the image.
kernel void loss_columns_backward(
//@@ arguments loss_columns_backward
) {
    LOCATE(ROWS_PER_ITEM);
    vfloat column_means[ROWS_PER_ITEM][5];
    columns_of(images + 2 * image_stride + at, 3, stride, image_stride, column_means);
    for (int row_offset = 0; row_offset < ROWS_PER_ITEM && row < height; row_offset++, row++, at += stride) {
        vfloat grad_mean = column_means[row_offset][0], grad_variance = column_means[row_offset][1], grad_shared = column_means[row_offset][2];
        vfloat a = VLOAD(images + at), b = VLOAD(images + image_stride + at);
        vfloat slope = sign(a - b) * l1_weight - (grad_mean + 2.0f * a * grad_variance + b * grad_shared) * ssim_weight;
        float values[LANES];
        VSTORE(slope, values);
        for (int k = 0; k < LANES && column + k < width; k++) {
            bool counts = !masked || mask[(size_t)row * (width / 3) + (column + k) / 3];
            float gain = exposed ? GAIN((column + k) % 3) : 1.0f;
            grad_rgb[(size_t)row * width + column + k] = counts ? gain * values[k] : 0.0f;
        }
    }
}

// Index space: any number of work-groups of SUM_ITEMS. Reads: images 0, 1 and 10, zero margins included; if `exposed`, the render and its gradient.
// Writes: each work-group's sums of |a - b|, (a - b)^2 and the SSIM, and of the gradients with respect to the logarithms of the gains and the
// offsets, in a fixed order (deterministic). A group sums a contiguous range of the images.
#define SUM_ITEMS 128
kernel __attribute__((reqd_work_group_size(SUM_ITEMS, 1, 1))) void loss_sums(
//@@ arguments loss_sums
) {
    local real partial[9][SUM_ITEMS];
    uint item = get_local_id(0), columns = exposed ? 9 : 3;
    real by_gain[3] = {0}, by_offset[3] = {0};
    real absolute = 0, squared = 0, ssim = 0;
    size_t piece = (image_stride + get_num_groups(0) - 1) / get_num_groups(0), first = get_group_id(0) * piece;
    for (size_t at = first + item; at < min(first + piece, (size_t)image_stride); at += SUM_ITEMS) {
        float difference = images[at] - images[image_stride + at];
        absolute += fabs(difference);
        squared += difference * difference;
        ssim += images[10 * image_stride + at];
        if (!exposed) continue;
        int row = (int)(at / stride) - MARGIN_ROWS, column = (int)(at % stride) - MARGIN;
        if (row < 0 || row >= height || column < 0 || column >= width) continue;
        size_t pixel_value = (size_t)row * width + column;
        // outside of the mask the gradient is 0, and the render may not be finite
        float slope = grad_rgb[pixel_value], by_log_gain = slope == 0.0f ? 0.0f : slope * rgb[pixel_value];
#pragma unroll
        for (int channel = 0; channel < 3; channel++) {
            by_gain[channel] += column % 3 == channel ? by_log_gain : 0.0f;
            by_offset[channel] += column % 3 == channel ? slope : 0.0f;
        }
    }
    partial[0][item] = absolute;
    partial[1][item] = squared;
    partial[2][item] = ssim;
    if (exposed)
        for (int channel = 0; channel < 3; channel++) {
            partial[3 + channel][item] = by_gain[channel];
            partial[6 + channel][item] = by_offset[channel] / GAIN(channel);   // `grad_rgb` has the gain as a factor
        }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < columns) {
        real sum = 0;
        for (uint other = 0; other < SUM_ITEMS; other++) sum += partial[item][other];
        if (item < 3) sums[3 * get_group_id(0) + item] = (float)sum;
        else exposure_sums[6 * get_group_id(0) + item - 3] = (float)sum;
    }
}
