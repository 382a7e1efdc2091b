// Direct image alignment: residuals of an image against a render, and the sums of the normal equations of the camera pose. NumPy
// version: fidsplat/localisation/normal_equations.py.
// ITEMS   work-items of a group: 1 on CPUs
// FIRST_BIN  number of the first bin in the upper bits of a float
#pragma OPENCL FP_CONTRACT OFF
#define ROW_ITEMS (ITEMS < 16 ? ITEMS : 16)
#define BINS 256
#define CHANNEL_ROWS 10   // rows of 8 sums of a channel: the matrix, the right-hand side, and a second one or moments of image and render
#define SUMS (8 * (3 * CHANNEL_ROWS + 1))

// Bin of a positive number: 16 bins per octave from 2^-14 on.
static inline uint bin_of(float value) {
    return (uint)clamp((int)(as_uint(value) >> 19) - FIRST_BIN, 1, BINS - 1);
}

// A channel of a pixel; of a grey image the mean of the rendered channels.
static inline float value_of(global const float *image, int i, int channel, int channels) {
    global const float *at = image + 3 * (size_t)i;
    return channels == 1 ? (at[0] + at[1] + at[2]) / 3.0f : at[channel];
}

// Index space: (columns, rows) of the level. Reads: a larger image. Writes: means over the pixels of the level.
kernel void align_downsample(
//@@ arguments align_downsample
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    float left = x * ratio_x, right = left + ratio_x, top = y * ratio_y, bottom = top + ratio_y, sum[3] = {0.0f, 0.0f, 0.0f};
    int end_x = min((int)ceil(right - 1e-3f), full_width), end_y = min((int)ceil(bottom - 1e-3f), full_height);
    for (int row = (int)top; row < end_y; row++)
        for (int column = (int)left; column < end_x; column++) {
            global const float *at = image + (row * (size_t)full_width + column) * channels;
            float share = fmin(right, column + 1.0f) - fmax(left, (float)column);
            share *= fmin(bottom, row + 1.0f) - fmax(top, (float)row);
            for (int c = 0; c < channels; c++) sum[c] += share * at[c];
        }
    for (int c = 0; c < channels; c++) result[(y * (size_t)width + x) * channels + c] = sum[c] / (ratio_x * ratio_y);
}

// Index space: (any number, rows). Reads: an image. Writes: its convolution along x or y with symmetric taps; the border is repeated.
kernel void align_blur(
//@@ arguments align_blur
) {
    int y = get_global_id(1), first = get_global_id(0), count = width * channels, step = get_global_size(0);
    global const float *own = image + y * (size_t)count;
    global float *into = result + y * (size_t)count;
    for (int i = first; i < count; i += step) into[i] = taps[0] * own[i];
    for (int k = 1; k <= radius; k++) {
        if (vertical) {
            global const float *low = image + max(y - k, 0) * (size_t)count, *high = image + min(y + k, height - 1) * (size_t)count;
            for (int i = first; i < count; i += step) into[i] += taps[k] * (low[i] + high[i]);
            continue;
        }
        int shift = k * channels;
        for (int i = first; i < count; i += step) {
            int low = i >= shift ? i - shift : i % channels, high = i + shift < count ? i + shift : count - channels + i % channels;
            into[i] += taps[k] * (own[low] + own[high]);
        }
    }
}

// Add a work-group's histogram to the histogram of all groups.
static inline void add_bins(local uint *group_counts, global uint *counts) {
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = get_local_id(0); k < BINS; k += ITEMS)
        if (group_counts[k]) atomic_add(&counts[k], group_counts[k]);
}

#if ITEMS == 1
#define COUNT(counters, bin) (counters)[bin]++
#else
#define COUNT(counters, bin) atomic_inc(&(counters)[bin])
#endif

// Index space: any number of work-groups of ITEMS, by rows. Reads: the image of a level. Writes: the bin of each pixel's gradient, 0
// on the border and for ignored pixels, and adds the numbers of pixels.
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void align_texture(
//@@ arguments align_texture
) {
    local uint group_counts[BINS];
    for (uint k = get_local_id(0); k < BINS; k += ITEMS) group_counts[k] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int y = get_group_id(0); y < height; y += get_num_groups(0))
        for (int x = get_local_id(0); x < width; x += ITEMS) {
            int i = y * width + x;
            uint bin = 0;
            if (x > 0 && y > 0 && x + 1 < width && y + 1 < height && !(masked && mask[i])) {
                float energy = 0.0f;
                for (int c = 0; c < channels; c++) {
                    float across = image[(i + 1) * channels + c] - image[(i - 1) * channels + c];
                    float down = image[(i + width) * channels + c] - image[(i - width) * channels + c];
                    energy += across * across + down * down;
                }
                bin = bin_of(sqrt(energy) / 2.0f);
            }
            bins[i] = (uchar)bin;
            COUNT(group_counts, bin);
        }
    add_bins(group_counts, counts + row * BINS);
}

// Residuals of a pixel: image, without gain and offset, minus render. Returns their root mean square.
static inline float residuals_of(
    int i, int channels, global const float *image, global const float *rgb, const float *gain, const float *offset, float *residual
) {
    float square = 0.0f;
    for (int c = 0; c < channels; c++) {
        residual[c] = (image[(size_t)i * channels + c] - offset[c]) / gain[c] - value_of(rgb, i, c, channels);
        square += residual[c] * residual[c];
    }
    return sqrt(square / channels);
}

#define EXPOSURE const float gain[3] = {fit[0], fit[1], fit[2]}, offset[3] = {fit[3], fit[4], fit[5]}

// Index space: any number of work-groups of ITEMS, by rows. Adds the errors of textured pixels to a histogram.
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void align_errors(
//@@ arguments align_errors
) {
    local uint group_counts[BINS];
    EXPOSURE;
    for (uint k = get_local_id(0); k < BINS; k += ITEMS) group_counts[k] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int y = get_group_id(0); y < height; y += get_num_groups(0))
        for (int i = y * width + get_local_id(0); i < (y + 1) * width; i += ITEMS) {
            float residual[3];
            if (bins[i] < min_bin) continue;
            COUNT(group_counts, bin_of(residuals_of(i, channels, image, rgb, gain, offset, residual)));
        }
    add_bins(group_counts, counts);
}

// Median of a histogram, linear within its bin.
static inline float median_of(global const uint *counts) {
    uint total = 0, before = 0, k = 1;
    for (uint other = 1; other < BINS; other++) total += counts[other];
    while (k < BINS - 1 && 2 * (before + counts[k]) < total) before += counts[k++];
    float low = as_float((FIRST_BIN + k) << 19), high = as_float((FIRST_BIN + k + 1) << 19);
    return low + (high - low) * (0.5f * total - before) / fmax((float)counts[k], 1.0f);
}

// Set the weight, the weight of the second derivative, and the loss of an error.
static inline void robust(float error, float noise, int huber, int channels, float *weight, float *hessian_weight, float *cost) {
    float normalised = error / (huber ? HUBER * noise : TUKEY * fmin(noise, MAX_NOISE));
    if (huber) {
        *weight = *hessian_weight = 1.0f / fmax(normalised, 1.0f);
        *cost = normalised < 1.0f ? 0.5f * normalised * normalised : normalised - 0.5f;
        return;
    }
    float inner = fmax(1.0f - normalised * normalised, 0.0f);
    *weight = inner * inner;
    *hessian_weight = fmax(inner * inner - 4.0f * normalised * normalised * inner / channels, 0.0f);
    *cost = 1.0f - inner * inner * inner;
}

// Inverse depth, the largest of a pixel and its neighbours; 0 for the background.
static inline float nearest(global const float *depth, int i, int width) {
    float depths[5] = {depth[i], depth[i - 1], depth[i + 1], depth[i - width], depth[i + width]}, largest = 0.0f;
    for (int k = 0; k < 5; k++)
        if (depths[k] > 0.0f) largest = fmax(largest, 1.0f / depths[k]);
    return largest;
}

// Index space: work-groups of ITEMS; group g has the blocks g, g + groups, ... of block_size x block_size pixels. Reads: image, render, depth,
// the rays of a lens, counts of `align_errors`, the render after a motion. Writes: the sums of each group, in a fixed order.
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void align_sums(
//@@ arguments align_sums
) {
    local float partial[ITEMS][SUMS];
    local float shared_noise;
    EXPOSURE;
    const float noise_before = fit[6];
    uint item = get_local_id(0);
    if (item == 0) {
        float own = fmax(noise_factor * median_of(counts), MIN_NOISE);
        shared_noise = noise_before > 0.0f ? fmin(own, noise_before) : own;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    float noise = shared_noise;
    // others: squares of three channels, number of pixels, two losses, squared inverse depths
    float8 totals[CHANNEL_ROWS * 3], others = 0.0f;
    for (int k = 0; k < CHANNEL_ROWS * 3; k++) totals[k] = 0.0f;
    int across_blocks = (width + block_size - 1) / block_size, blocks = across_blocks * ((height + block_size - 1) / block_size);
    for (int block = get_group_id(0); block < blocks; block += get_num_groups(0)) {
        int left = block % across_blocks * block_size, top = block / across_blocks * block_size;
        int right = min(left + block_size, width), bottom = min(top + block_size, height);
        for (int y = top + item / ROW_ITEMS; y < bottom; y += ITEMS / ROW_ITEMS)
            for (int x = left + item % ROW_ITEMS; x < right; x += ROW_ITEMS) {
                int i = y * width + x;
                if (bins[i] < min_bin) continue;
                float residual[3], weight, hessian_weight, cost, before;
                float error = residuals_of(i, channels, image, rgb, gain, offset, residual), inverse = nearest(depth, i, width);
                robust(error, noise_before > 0.0f ? noise_before : noise, huber, channels, &weight, &hessian_weight, &before);
                robust(error, noise, huber, channels, &weight, &hessian_weight, &cost);
                float3 ray = {(x + 0.5f - center_x) / focal_x, (y + 0.5f - center_y) / focal_y, 1.0f};
                float3 ray_dx = {1.0f / focal_x, 0.0f, 0.0f}, ray_dy = {0.0f, 1.0f / focal_y, 0.0f};
                if (lens) {
                    ray = vload3(i, rays);
                    ray_dx = (vload3(i + 1, rays) - vload3(i - 1, rays)) / 2.0f;
                    ray_dy = (vload3(i + width, rays) - vload3(i - width, rays)) / 2.0f;
                }
                // derivatives of pixel coordinates with respect to the point: the dual basis of the rays' derivatives
                float3 across = cross(ray_dy, ray), down = cross(ray, ray_dx);
                across /= dot(ray_dx, across);
                down /= dot(ray_dy, down);
                float3 rotation_x = cross(ray, across), rotation_y = cross(ray, down);
                float8 motion_x = (float8)(rotation_x, across * inverse, 0.0f, 0.0f), motion_y = (float8)(rotation_y, down * inverse, 0.0f, 0.0f);
                // with `has_perturbed` the right-hand side is a column of the Hessian, else the gradient
                float scale = axis == 0 ? -ray.x : axis == 1 ? -ray.y : -ray.z, column_weight = has_perturbed ? hessian_weight : weight;
                float squares[3] = {0.0f, 0.0f, 0.0f};
                for (int c = 0; c < channels; c++) {
                    float gx = (value_of(rgb, i + 1, c, channels) - value_of(rgb, i - 1, c, channels)) / 2.0f;
                    float gy = (value_of(rgb, i + width, c, channels) - value_of(rgb, i - width, c, channels)) / 2.0f;
                    if (huber) {
                        gx = (gx + (image[(i + 1) * channels + c] - image[(i - 1) * channels + c]) / 2.0f / gain[c]) / 2.0f;
                        gy = (gy + (image[(i + width) * channels + c] - image[(i - width) * channels + c]) / 2.0f / gain[c]) / 2.0f;
                    }
                    float value = value_of(rgb, i, c, channels), column = residual[c];
                    if (has_perturbed) column = (value_of(perturbed, i, c, channels) - value) / step;
                    float8 row = -(gx * motion_x + gy * motion_y), *total = totals + c * CHANNEL_ROWS;
                    row.s67 = (float2)(value, 1.0f);
                    float8 weighted = hessian_weight * row, entry = column_weight * column * row;
                    for (int k = 0; k < 8; k++) total[k] += ((const float *)&weighted)[k] * row;
                    total[8] += entry;
                    float own = value + residual[c];
                    total[9] += has_perturbed ? scale * entry : (float8)(own, value, own * own, value * value, own * value, 1.0f, 0.0f, 0.0f);
                    squares[c] = weight * residual[c] * residual[c];
                }
                others += (float8)(squares[0], squares[1], squares[2], 1.0f, cost, before, inverse * inverse, 0.0f);
            }
    }
    local float *sums = partial[item];
    for (int k = 0; k < CHANNEL_ROWS * 3; k++) vstore8(totals[k], k, sums);
    vstore8(others, CHANNEL_ROWS * 3, sums);
    barrier(CLK_LOCAL_MEM_FENCE);
    size_t into = get_group_id(0) * (size_t)(SUMS + 1);
    for (int k = item; k < SUMS; k += ITEMS) {
        float sum = 0.0f;
        for (int other = 0; other < ITEMS; other++) sum += partial[other][k];
        result[into + k] = sum;
    }
    if (item == 0) result[into + SUMS] = noise;
}

// Index space: one work-group. Reads: the sums of `groups` work-groups, and the counts of the rendered frame. Writes: their totals, the
// noise, and 1 if the frame exceeded its buffers, else 0; clears the histogram of `align_errors`.
kernel void align_totals(
//@@ arguments align_totals
) {
    for (uint k = get_local_id(0); k < SUMS; k += get_local_size(0)) {
        float sum = 0.0f;
        for (int g = 0; g < groups; g++) sum += result[g * (size_t)(SUMS + 1) + k];
        totals[k] = sum;
    }
    for (uint k = get_local_id(0); k < BINS; k += get_local_size(0)) counts[k] = 0;
    if (get_local_id(0) == 0) {
        totals[SUMS] = result[SUMS];
        totals[SUMS + 1] = frame_counts[0] > big_capacity || frame_counts[1] > pair_capacity || frame_counts[2];
    }
}
