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

// Index space: (columns, rows) of the level. Reads: a larger or equal image, in 8 bits if `is_uint8`. Writes: means over the pixels of the
// level.
kernel void align_downsample(
//@@ arguments align_downsample
) {
    int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    float left = x * ratio_x, right = left + ratio_x, top = y * ratio_y, bottom = top + ratio_y, sum[3] = {0.0f, 0.0f, 0.0f};
    int end_x = min((int)ceil(right - 1e-3f), full_width), end_y = min((int)ceil(bottom - 1e-3f), full_height);
    for (int row = (int)top; row < end_y; row++)
        for (int column = (int)left; column < end_x; column++) {
            size_t at = (row * (size_t)full_width + column) * channels;
            float share = fmin(right, column + 1.0f) - fmax(left, (float)column);
            share *= fmin(bottom, row + 1.0f) - fmax(top, (float)row);
            for (int c = 0; c < channels; c++) sum[c] += share * (is_uint8 ? bytes[at + c] * (1.0f / 255.0f) : image[at + c]);
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

// Clear a work-group's histogram.
static inline void clear_bins(local uint *group_counts) {
    for (uint k = get_local_id(0); k < BINS; k += ITEMS) group_counts[k] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
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
    clear_bins(group_counts);
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
    add_bins(group_counts, counts + stage * BINS);
}

// Index space: any number of work-groups of ITEMS, by every eighth row. Adds half of the absolute second differences along the
// rows of an image to a histogram, for the noise of the image.
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void align_noise(
//@@ arguments align_noise
) {
    local uint group_counts[BINS];
    clear_bins(group_counts);
    for (int y = 8 * get_group_id(0); y < height; y += 8 * get_num_groups(0)) {
        global const float *row = image + y * (size_t)(width * channels);
        for (int i = channels + get_local_id(0); i < (width - 1) * channels; i += ITEMS)
            COUNT(group_counts, bin_of(fabs(row[i] - (row[i - channels] + row[i + channels]) / 2.0f)));
    }
    add_bins(group_counts, counts + stage * BINS);
}

#define SHARE (BINS / ITEMS)

// Median of a histogram, linear within its bin. Called by the complete group.
static inline float median_of(global const uint *counts, local uint *shares) {
    uint item = get_local_id(0), sum = 0, total = 0, before = 0, share = 0;
    for (uint k = 0; k < SHARE; k++) sum += item + k > 0 ? counts[item * SHARE + k] : 0;   // bin 0 is of unused pixels
    shares[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint other = 0; other < ITEMS; other++) total += shares[other];
    while (share < ITEMS - 1 && 2 * (before + shares[share]) < total) before += shares[share++];
    uint k = max(share * SHARE, 1u);
    while (k < BINS - 1 && 2 * (before + counts[k]) < total) before += counts[k++];
    float low = as_float((FIRST_BIN + k) << 19), high = as_float((FIRST_BIN + k + 1) << 19);
    return low + (high - low) * (0.5f * total - before) / fmax((float)counts[k], 1.0f);
}

// Index space: one work-group of ITEMS per stage, and one more. Reads and clears: the histograms of `align_texture` and `align_noise`.
// Writes: of each stage the lowest bin to use, so that it and the higher bins have about max_pixels pixels; their numbers of pixels; the
// median of the values of `align_noise`.
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void align_thresholds(
//@@ arguments align_thresholds
) {
    local uint shares[ITEMS];
    int stage = get_group_id(0);
    global uint *own = counts + stage * BINS;
    float median = median_of(own, shares);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (get_local_id(0) > 0) return;
    uint total = 0, pixels = 0, bin = BINS;
    if (stage == stages) thresholds[2 * stages] = as_uint(median);
    else {
        for (uint k = 1; k < BINS; k++) total += own[k];
        do pixels += own[--bin];
        while (bin > 1 && pixels < min(total, max_pixels));
        thresholds[stage] = bin;
        thresholds[stages + stage] = pixels;
    }
    for (uint k = 0; k < BINS; k++) own[k] = 0;
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

#define SPAN (ITEMS > 1 ? ITEMS : 1024)
#define CONVERGED 7   // index in `fit`: whether the level has converged, so that its sums are not needed
#define EXPOSURE const float gain[3] = {fit[0], fit[1], fit[2]}, offset[3] = {fit[3], fit[4], fit[5]}

#if ITEMS > 1
// A pixel of an image of three channels after `align_blur` along both axes.
static inline float3 blurred(global const float *image, int x, int y, int width, int height, global const float *taps, int radius) {
    float3 sum = 0.0f;
    for (int j = -radius; j <= radius; j++) {
        global const float *row = image + clamp(y + j, 0, height - 1) * (size_t)width * 3;
        float3 part = 0.0f;
        for (int i = -radius; i <= radius; i++) part += taps[abs(i)] * vload3(clamp(x + i, 0, width - 1), row);
        sum += taps[abs(j)] * part;
    }
    return sum;
}
#endif

// Index space: any number of work-groups of ITEMS, by SPAN pixels. Adds the errors of textured pixels to a histogram. On GPUs it also
// blurs the render, in the same launch.
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void align_errors(
//@@ arguments align_errors
) {
    local uint group_counts[BINS];
    EXPOSURE;
    uint min_bin = thresholds[stage];
    clear_bins(group_counts);
    int pixels = fit[CONVERGED] != 0.0f ? 0 : width * height;
    for (int first = get_group_id(0) * SPAN; first < pixels; first += get_num_groups(0) * SPAN)
        for (int i = first + get_local_id(0); i < min(first + SPAN, pixels); i += ITEMS) {
            float residual[3];
#if ITEMS > 1
            if (radius) vstore3(blurred(rendered, i % width, i / width, width, height, taps, radius), i, rgb);
#endif
            if (bins[i] < min_bin) continue;
            COUNT(group_counts, bin_of(residuals_of(i, channels, image, rgb, gain, offset, residual)));
        }
    add_bins(group_counts, counts);
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

// Inverse depth, the largest of a pixel and its neighbours; 0 for the background. depth: an image of depth_width columns, ratio_x and
// ratio_y pixels for each pixel of the level.
static inline float nearest(global const float *depth, int x, int y, int depth_width, float ratio_x, float ratio_y) {
    float largest = 0.0f;
    for (int k = 0; k < 5; k++) {
        int row = (int)((y + (k == 3) - (k == 4) + 0.5f) * ratio_y), column = (int)((x + (k == 1) - (k == 2) + 0.5f) * ratio_x);
        float one = depth[row * (size_t)depth_width + column];
        if (one > 0.0f) largest = fmax(largest, 1.0f / one);
    }
    return largest;
}

#if ITEMS > 1
#define CHANNELS 1   // channels of a work-group: the sums of one channel fit into registers
#else
#define CHANNELS 3
#endif
#define OWN_SUMS (8 * (CHANNEL_ROWS * CHANNELS + 1))

// Index space: work-groups of ITEMS, on GPUs for each channel; group g has the blocks g, g + groups, ... of block_size x block_size
// pixels. Reads: image, render, depth, the rays of a lens, counts of `align_errors`, the render after a motion. Writes: the sums of each
// group, in a fixed order.
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void align_sums(
//@@ arguments align_sums
) {
    local float partial[ITEMS][OWN_SUMS + 1];
    local uint shares[ITEMS];
    EXPOSURE;
    uint min_bin = thresholds[stage];
    const float noise_before = fit[6];
    uint item = get_local_id(0);
    int parts = CHANNELS == 1 ? channels : 1, first_channel = get_group_id(0) % parts, end_channel = min(first_channel + CHANNELS, channels);
    int group = get_group_id(0) / parts, groups = get_num_groups(0) / parts;
    float noise = fmax(noise_factor * median_of(counts, shares), MIN_NOISE);
    if (noise_before > 0.0f) noise = fmin(noise, noise_before);
    // others: squares of three channels, number of pixels, two losses, squared inverse depths
    float8 totals[CHANNEL_ROWS * CHANNELS], others = 0.0f;
    for (int k = 0; k < CHANNEL_ROWS * CHANNELS; k++) totals[k] = 0.0f;
    int across_blocks = (width + block_size - 1) / block_size, blocks = across_blocks * ((height + block_size - 1) / block_size);
    if (fit[CONVERGED] != 0.0f) blocks = 0;   // PoCL 3 executes later barriers wrongly after a return
    for (int block = group; block < blocks; block += groups) {
        int left = block % across_blocks * block_size, top = block / across_blocks * block_size;
        int right = min(left + block_size, width), bottom = min(top + block_size, height);
        for (int y = top + item / ROW_ITEMS; y < bottom; y += ITEMS / ROW_ITEMS)
            for (int x = left + item % ROW_ITEMS; x < right; x += ROW_ITEMS) {
                int i = y * width + x;
                if (bins[i] < min_bin) continue;
                float residual[3], weight, hessian_weight, cost, before;
                float error = residuals_of(i, channels, image, rgb, gain, offset, residual), inverse = nearest(depth, x, y, depth_width, ratio_x, ratio_y);
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
                for (int c = first_channel; c < end_channel; c++) {
                    float gx = (value_of(rgb, i + 1, c, channels) - value_of(rgb, i - 1, c, channels)) / 2.0f;
                    float gy = (value_of(rgb, i + width, c, channels) - value_of(rgb, i - width, c, channels)) / 2.0f;
                    if (huber) {
                        gx = (gx + (image[(i + 1) * channels + c] - image[(i - 1) * channels + c]) / 2.0f / gain[c]) / 2.0f;
                        gy = (gy + (image[(i + width) * channels + c] - image[(i - width) * channels + c]) / 2.0f / gain[c]) / 2.0f;
                    }
                    float value = value_of(rgb, i, c, channels), column = residual[c];
                    if (has_perturbed) column = (value_of(perturbed, i, c, channels) - value) / step;
                    float8 row = -(gx * motion_x + gy * motion_y), *total = totals + (c - first_channel) * CHANNEL_ROWS;
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
    for (int k = 0; k < CHANNEL_ROWS * CHANNELS; k++) vstore8(totals[k], k, sums);
    vstore8(others, CHANNEL_ROWS * CHANNELS, sums);
    barrier(CLK_LOCAL_MEM_FENCE);
    // the scalars of all channels are those of the first, except the squares
    global float *into = result + group * (size_t)(SUMS + 1);
    for (int k = item; k < OWN_SUMS; k += ITEMS) {
        int scalar = k - 8 * CHANNEL_ROWS * CHANNELS;
        if (CHANNELS == 1 && scalar >= 0 && scalar != first_channel && (scalar < 3 || first_channel > 0)) continue;
        float sum = 0.0f;
        for (int other = 0; other < ITEMS; other++) sum += partial[other][k];
        into[scalar < 0 ? 8 * CHANNEL_ROWS * first_channel + k : 8 * CHANNEL_ROWS * 3 + scalar] = sum;
    }
    if (item == 0 && first_channel == 0) into[SUMS] = noise;
}
