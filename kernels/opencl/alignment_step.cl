// Steps of Levenberg-Marquardt and small motions of the camera for direct image alignment, which write the next pose into the uniforms of
// the view. NumPy version: `_minimise` in fidsplat/localisation/direct_alignment.py.
//@@ struct View
#define CHANNEL_ROWS 10
#define SUMS (8 * (3 * CHANNEL_ROWS + 1))
#define BINS 256
#define SIZE 12   // unknowns of three channels: pose (6), then gain and offset of each channel
#define POSE 15   // rotation, translation and eye: the first members of a view

// Columns of a channel's sums after the pose: rendered value, and 1. `AT`: index of a row's sum; the row RESIDUAL has the right-hand side.
enum { VALUE = 6, ONE, RESIDUAL };
#define AT(row, column) (8 * (row) + (column))

// Sums after those of the channels.
enum { SQUARES = 24 * CHANNEL_ROWS, PIXELS = SQUARES + 3, LOSS, LOSS_BEFORE, SQUARED_INVERSE_DEPTHS };

// Layout of `state`: gain, offset and noise of the next frame (`fit` of alignment.cl); then the estimate at the last accepted pose, with
// its normal equations. INCOMPLETE: whether a frame exceeded its buffers.
enum { CONVERGED = 7, NOISE, INCOMPLETE, EXPOSURE_KNOWN, COST, DAMPING, INVERSE_DEPTH, GAIN, OFFSET = GAIN + 3,
       GAIN_CHANGE = OFFSET + 3, OFFSET_CHANGE = GAIN_CHANGE + 3, RHS = OFFSET_CHANGE + 3, MATRIX = RHS + SIZE };

// Exposure changes of a channel that equalise mean and standard deviation of the blurred images. m: the channel's sums.
static inline void exposure_of(local const float *m, float squares, global float *gain, global float *offset) {
    float count = m[AT(ONE, ONE)], value = m[AT(VALUE, ONE)] / count, residual = m[AT(RESIDUAL, ONE)] / count;
    float variance = fmax(m[AT(VALUE, VALUE)] / count - value * value, 1e-12f), mixed = m[AT(RESIDUAL, VALUE)] / count - value * residual;
    float image = variance + 2.0f * mixed + squares / count - residual * residual;
    *gain = sqrt(fmax(image, 1e-12f) / variance);
    *offset = value + residual - *gain * value;
}

// Element of the normal equations of all channels: of the matrix, or of the right-hand side if column == SIZE.
static inline float element(local const float *sums, int channels, int row, int column) {
    float sum = 0.0f;
    for (int c = 0; c < channels; c++) {
        int i = row < 6 ? row : row - 2 * c, j = column < 6 ? column : column == SIZE ? RESIDUAL : column - 2 * c;
        bool used = (row < 6 || row / 2 == 3 + c) && (column < 6 || column == SIZE || column / 2 == 3 + c);
        local const float *m = sums + c * 8 * CHANNEL_ROWS;
        if (used) sum += m[AT(j, i)];
        if (used && row == column && row >= 6) sum += 1e-9f * (1.0f + m[AT(VALUE, VALUE)] + m[AT(ONE, ONE)]);
    }
    return sum;
}

// Set the view to the pose after a motion.
static inline void set_view(global const real *pose, const float *motion, global View *view) {
    real before[12], moved[6];
    for (int k = 0; k < 12; k++) before[k] = pose[k];
    for (int k = 0; k < 6; k++) moved[k] = motion[k];
    move(before, moved, (global real *)view);
}

// Index space: one work-item. Starts a stage, at the pose `before`; `near`: the view's near plane.
kernel void align_start(
//@@ arguments align_start
) {
    real first[POSE];
    for (int k = 0; k < POSE; k++) first[k] = before[k];
    for (int k = 0; k < POSE; k++) pose[k] = ((global real *)view)[k] = first[k];
    view->near = near;
    state[CONVERGED] = 0.0f;
    state[6] = 0.0f;   // the noise of this stage is not known
    state[COST] = INFINITY;
    state[DAMPING] = 10.0f * damping;
}

// Index space: one work-group. Reads: the sums of `groups` work-groups, and the counts of the rendered frame. Writes: their totals and
// the pose of the next frame: by a step of Levenberg-Marquardt, with the exposure (STEP), or `pose` after a motion along an axis; the
// latter keep the histogram of `align_errors`. A stage that has converged culls all splats of its next frames.
kernel __attribute__((reqd_work_group_size(BINS, 1, 1))) void align_step(
//@@ arguments align_step
) {
    local float sums[SUMS], equations[SIZE][SIZE + 1];
    int item = get_local_id(0), i = item / (SIZE + 1), j = item % (SIZE + 1), size = 6 + 2 * channels;
    if (state[CONVERGED] != 0.0f) return;
    if (item < SUMS) {
        float sum = 0.0f;
        for (int g = 0; g < groups; g++) sum += result[g * (size_t)(SUMS + 1) + item];
        totals[row * SUMS + item] = sums[item] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    float count = fmax(sums[PIXELS], 1.0f), damping = state[DAMPING], inverse_depth = sums[SQUARED_INVERSE_DEPTHS] / count;
    bool incomplete = frame_counts[0] > big_capacity || frame_counts[1] > pair_capacity || frame_counts[2];
    if (axis != STEP) {
        if (item > 0) return;
        if (incomplete) state[INCOMPLETE] = 1.0f;
        float motion[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        if (axis < 6) motion[axis] = axis < 3 ? difference / focal : difference / focal / fmax(sqrt(inverse_depth), 1e-3f);
        set_view(pose, motion, view);
        return;
    }
    counts[item] = 0;
    bool accepted = sums[LOSS_BEFORE] / count <= state[COST], exposure_known = state[EXPOSURE_KNOWN] != 0.0f;
    damping = accepted ? fmax(damping / 10.0f, 1e-6f) : damping * 10.0f;
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (accepted) {
        if (i < SIZE && j == SIZE) state[RHS + i] = element(sums, channels, i, SIZE);
        if (i < SIZE && j < SIZE) state[MATRIX + i * SIZE + j] = element(sums, channels, i, j);
        if (item < channels)
            exposure_of(sums + item * 8 * CHANNEL_ROWS, sums[SQUARES + item], &state[GAIN_CHANGE + item], &state[OFFSET_CHANGE + item]);
        if (item < 6) state[GAIN + item] = state[item];
        if (item < POSE) pose[item] = ((global const real *)view)[item];
        if (item == 0) {
            state[COST] = sums[LOSS] / count;
            state[INVERSE_DEPTH] = inverse_depth;
            state[NOISE] = result[SUMS];
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (item < channels) {
        state[item] = clamp(state[GAIN + item] * state[GAIN_CHANGE + item], MIN_GAIN, MAX_GAIN);
        state[3 + item] = state[OFFSET + item] + state[GAIN + item] * state[OFFSET_CHANGE + item];
    }
    if (item == 0) state[DAMPING] = damping;
    if (incomplete || sums[PIXELS] == 0.0f) {
        if (item == 0) state[CONVERGED] = state[INCOMPLETE] = 1.0f;
        return;
    }
    if (!exposure_known) {   // the first sums determine the exposure alone
        if (item == 0) {
            state[EXPOSURE_KNOWN] = 1.0f;
            state[COST] = INFINITY;
            state[DAMPING] = damping * 10.0f;
        }
        return;
    }
    // solve the damped normal equations, scaled by the diagonal, by elimination
    float trace = 0.0f, scale = 0.0f;
    for (int k = 0; k < 6; k++) trace += state[MATRIX + k * SIZE + k];
#define DAMPED(k) (state[MATRIX + (k) * SIZE + (k)] * ((k) < 6 ? 1.0f + damping : 1.0f) + ((k) < 6 ? 1e-9f * fmax(trace, 1e-9f) : 0.0f))
    bool used = i < size && (j < size || j == SIZE);
    if (used) {
        scale = rsqrt(DAMPED(i));
        equations[i][j] = i == j ? 1.0f
            : j == SIZE ? state[RHS + i] * scale : state[MATRIX + i * SIZE + j] * scale * rsqrt(DAMPED(j));
    }
    for (int k = 0; k < size; k++) {
        barrier(CLK_LOCAL_MEM_FENCE);
        float change = 0.0f;
        if (used && i != k) change = equations[i][k] / fmax(equations[k][k], 1e-6f) * equations[k][j];
        barrier(CLK_LOCAL_MEM_FENCE);
        if (used && i != k) equations[i][j] -= change;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item > 0) return;
    float step[6];
    for (int k = 0; k < 6; k++) step[k] = equations[k][SIZE] / fmax(equations[k][k], 1e-6f) * rsqrt(DAMPED(k));
    state[6] = state[NOISE];
    set_view(pose, step, view);
    float angle_square = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
    float shift_square = step[3] * step[3] + step[4] * step[4] + step[5] * step[5];
    if (focal * sqrt(angle_square + shift_square * state[INVERSE_DEPTH]) < tolerance) {
        state[CONVERGED] = 1.0f;
        view->near = INFINITY;
    }
}
