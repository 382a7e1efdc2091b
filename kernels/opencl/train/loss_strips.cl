// Training loss for CPUs (loss_values.cl): a work-item processes a strip of PANEL values from top to bottom, and keeps the row-wise
// means of the last TAPS rows, so that the column-wise means read from the first-level cache.
// Index space of both kernels: (panels, strips), each a work-group.

#define PANEL 128
#define VECTORS (PANEL / LANES)
#define STRIP 64
#define TAPS (2 * RADIUS + 1)

// Loads a row of the render and of the target from `column` - MARGIN on, zeros outside of the image. Where the mask is 0 the render
// is replaced by the target.
static inline void load_row(
    float *a, float *b, int column, int width, global const float *rgb, global const uchar *target, int masked,
    global const uchar *mask
) {
    for (int k = 0; k < PANEL + 2 * MARGIN; k += LANES) {
        int from = column - MARGIN + k;
        if (!masked && from >= 0 && from + LANES <= width) {
            VSTORE(VLOAD(rgb + from), a + k);
            VSTORE(VFLOAT(VLOAD(target + from)) * (1.0f / 255), b + k);
            continue;
        }
        for (int lane = 0; lane < LANES; lane++) {
            int at = from + lane;
            bool inside = at >= 0 && at < width;
            float target_value = inside ? target[at] * (1.0f / 255) : 0.0f;
            b[k + lane] = target_value;
            a[k + lane] = inside && (!masked || mask[at / 3]) ? rgb[at] : target_value;
        }
    }
}

static inline real sum_of(vfloat v) {
    float values[LANES];
    VSTORE(v, values);
    real sum = 0;
    for (int lane = 0; lane < LANES; lane++) sum += values[lane];
    return sum;
}

// Reads: the render, the target, the mask. Writes: images 0 to 2, the gradients of the SSIM with respect to the means of a, a a and a b; each
// work-group's sums of |a - b|, (a - b)^2 and the SSIM.
kernel __attribute__((reqd_work_group_size(1, 1, 1))) void loss_strips(
//@@ arguments loss_strips
) {
    const int left = get_global_id(0) * PANEL, first = get_global_id(1) * STRIP, end = min(first + STRIP, height);
    float a[PANEL + 2 * MARGIN], b[PANEL + 2 * MARGIN];
    vfloat means[TAPS][5 * VECTORS];
    real absolute = 0, squared = 0, ssim = 0;
    for (int row = first - RADIUS; row < end + RADIUS; row++) {
        bool there = row >= 0 && row < height;
        size_t from = there ? (size_t)row * width : 0;
        load_row(a, b, left, there ? width : 0, rgb + from, target + from, masked, mask + from / 3);
        vfloat differences = 0, squares = 0;
        for (int vector = 0; vector < VECTORS; vector++) {
            vfloat sum_a = 0, sum_b = 0, sum_aa = 0, sum_bb = 0, sum_ab = 0;
            int at = MARGIN + vector * LANES;
#pragma unroll
            for (int k = -RADIUS; k <= RADIUS; k++) {
                vfloat x = VLOAD(a + at + 3 * k), y = VLOAD(b + at + 3 * k), w = WINDOW[k + RADIUS];
                sum_a = FMA(w, x, sum_a);
                sum_b = FMA(w, y, sum_b);
                sum_aa = FMA(w, x * x, sum_aa);
                sum_bb = FMA(w, y * y, sum_bb);
                sum_ab = FMA(w, x * y, sum_ab);
            }
            vfloat *here = means[(row + TAPS) % TAPS] + 5 * vector;
            here[0] = sum_a, here[1] = sum_b, here[2] = sum_aa, here[3] = sum_bb, here[4] = sum_ab;
            if (row >= first && row < end) {
                vfloat difference = VLOAD(a + at) - VLOAD(b + at);
                differences += fabs(difference);
                squares = FMA(difference, difference, squares);
            }
        }
        absolute += sum_of(differences);
        squared += sum_of(squares);

        int y = row - RADIUS;
        if (y < first) continue;
        vfloat ssim_sum = 0;
        const vfloat *rows[TAPS];
        for (int k = 0; k < TAPS; k++) rows[k] = means[(y - RADIUS + k + TAPS) % TAPS];
        size_t to = (size_t)(y + MARGIN_ROWS) * stride + MARGIN + left;
        for (int vector = 0, column = left; vector < VECTORS && column < width; vector++, column += LANES, to += LANES) {
            vfloat mean_a = 0, mean_b = 0, mean_aa = 0, mean_bb = 0, mean_ab = 0;
#pragma unroll
            for (int k = 0; k < TAPS; k++) {
                const vfloat *row_means = rows[k] + 5 * vector;
                vfloat w = WINDOW[k];
                mean_a = FMA(w, row_means[0], mean_a);
                mean_b = FMA(w, row_means[1], mean_b);
                mean_aa = FMA(w, row_means[2], mean_aa);
                mean_bb = FMA(w, row_means[3], mean_bb);
                mean_ab = FMA(w, row_means[4], mean_ab);
            }
            const Ssim terms = ssim_of(mean_a, mean_b, mean_aa, mean_bb, mean_ab);
            VSTORE(INSIDE(terms.grad_mean), images + to);
            VSTORE(INSIDE(terms.grad_variance), images + image_stride + to);
            VSTORE(INSIDE(terms.grad_shared), images + 2 * image_stride + to);
            ssim_sum += INSIDE(terms.ssim);
        }
        ssim += sum_of(ssim_sum);
    }
    size_t group = get_global_id(1) * get_global_size(0) + get_global_id(0);
    sums[3 * group] = (float)absolute;
    sums[3 * group + 1] = (float)squared;
    sums[3 * group + 2] = (float)ssim;
}

// Reads: images 0 to 2, the render, the target, the mask. Writes: the gradient of the loss, in the shape of the image.
kernel __attribute__((reqd_work_group_size(1, 1, 1))) void loss_strips_backward(
//@@ arguments loss_strips_backward
) {
    const int left = get_global_id(0) * PANEL, first = get_global_id(1) * STRIP, end = min(first + STRIP, height);
    vfloat means[TAPS][3 * VECTORS];
    for (int row = first - RADIUS; row < end + RADIUS; row++) {
        global const float *from = images + (size_t)(row + MARGIN_ROWS) * stride + MARGIN + left;
        for (int vector = 0; vector < VECTORS && left + vector * LANES < width; vector++, from += LANES) {
            vfloat grad_mean = 0, grad_variance = 0, grad_shared = 0;
#pragma unroll
            for (int k = -RADIUS; k <= RADIUS; k++) {
                vfloat w = WINDOW[k + RADIUS];
                grad_mean = FMA(w, VLOAD(from + 3 * k), grad_mean);
                grad_variance = FMA(w, VLOAD(from + image_stride + 3 * k), grad_variance);
                grad_shared = FMA(w, VLOAD(from + 2 * image_stride + 3 * k), grad_shared);
            }
            vfloat *here = means[(row + TAPS) % TAPS] + 3 * vector;
            here[0] = grad_mean, here[1] = grad_variance, here[2] = grad_shared;
        }
        int y = row - RADIUS;
        if (y < first) continue;
        const vfloat *rows[TAPS];
        for (int k = 0; k < TAPS; k++) rows[k] = means[(y - RADIUS + k + TAPS) % TAPS];
        float a[PANEL + 2 * MARGIN], b[PANEL + 2 * MARGIN];
        size_t at = (size_t)y * width;
        load_row(a, b, left, width, rgb + at, target + at, masked, mask + at / 3);
        for (int vector = 0, column = left; vector < VECTORS && column < width; vector++, column += LANES) {
            vfloat grad_mean = 0, grad_variance = 0, grad_shared = 0;
#pragma unroll
            for (int k = 0; k < TAPS; k++) {
                const vfloat *terms = rows[k] + 3 * vector;
                vfloat w = WINDOW[k];
                grad_mean = FMA(w, terms[0], grad_mean);
                grad_variance = FMA(w, terms[1], grad_variance);
                grad_shared = FMA(w, terms[2], grad_shared);
            }
            vfloat x = VLOAD(a + MARGIN + vector * LANES), target_value = VLOAD(b + MARGIN + vector * LANES);
            vfloat slope = sign(x - target_value) * l1_weight - (grad_mean + 2.0f * x * grad_variance + target_value * grad_shared) * ssim_weight;
            if (!masked && column + LANES <= width) {
                VSTORE(slope, grad_rgb + at + column);
                continue;
            }
            float values[LANES];
            VSTORE(slope, values);
            for (int k = 0; k < LANES && column + k < width; k++) {
                bool counts = !masked || mask[(at + column + k) / 3];
                grad_rgb[at + column + k] = counts ? values[k] : 0.0f;
            }
        }
    }
}
