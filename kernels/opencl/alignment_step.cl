// A step of Levenberg-Marquardt for direct image alignment. NumPy version: `_minimise` in fidsplat/localisation/direct_alignment.py.
#define CHANNEL_ROWS 10
#define SIZE 12   // unknowns of three channels: pose (6), then gain and offset of each channel

// Columns of a channel's sums after the pose: rendered value, and 1. `AT`: index of a row's sum in `totals`; the row RESIDUAL has the
// right-hand side.
enum { VALUE = 6, ONE, RESIDUAL };
#define AT(row, column) (8 * (row) + (column))

// Totals after those of the channels.
enum { SQUARES, PIXELS = 3, LOSS, LOSS_BEFORE, SQUARED_INVERSE_DEPTHS, NOISE_OF_FRAME = 8, OVERFLOW };

// Layout of `state`: pose and exposure of the next frame; the estimate at the last accepted pose, with its normal equations.
enum { CONVERGED, NOISE, NEXT_POSE, NEXT_FIT = NEXT_POSE + 12, COST = NEXT_FIT + 6, DAMPING, INVERSE_DEPTH, EXPOSURE_KNOWN, GAIN,
       OFFSET = GAIN + 3, GAIN_CHANGE = OFFSET + 3, OFFSET_CHANGE = GAIN_CHANGE + 3, RHS = OFFSET_CHANGE + 3, MATRIX = RHS + SIZE };

// Exposure changes of a channel that equalise mean and standard deviation of the blurred images. m: the channel's sums.
static inline void exposure_of(global const float *m, float squares, global float *gain, global float *offset) {
    float count = m[AT(ONE, ONE)], value = m[AT(VALUE, ONE)] / count, residual = m[AT(RESIDUAL, ONE)] / count;
    float variance = fmax(m[AT(VALUE, VALUE)] / count - value * value, 1e-12f), mixed = m[AT(RESIDUAL, VALUE)] / count - value * residual;
    float image = variance + 2.0f * mixed + squares / count - residual * residual;
    *gain = sqrt(fmax(image, 1e-12f) / variance);
    *offset = value + residual - *gain * value;
}

// Store the normal equations of the totals, and the changes of exposure.
static inline void accept(global const float *totals, int channels, global float *state) {
    global float *matrix = state + MATRIX;
    for (int k = 0; k < SIZE * SIZE; k++) matrix[k] = 0.0f;
    for (int k = 0; k < SIZE; k++) state[RHS + k] = 0.0f;
    for (int c = 0; c < channels; c++) {
        global const float *m = totals + c * 8 * CHANNEL_ROWS;
        for (int i = 0; i < 8; i++) {
            int row = i < 6 ? i : i + 2 * c;
            state[RHS + row] += m[AT(RESIDUAL, i)];
            for (int j = 0; j < 8; j++) matrix[row * SIZE + (j < 6 ? j : j + 2 * c)] += m[AT(i, j)];
        }
        for (int i = 6 + 2 * c; i < 8 + 2 * c; i++) matrix[i * SIZE + i] += 1e-9f * (1.0f + m[AT(VALUE, VALUE)] + m[AT(ONE, ONE)]);
        exposure_of(m, totals[24 * CHANNEL_ROWS + SQUARES + c], &state[GAIN_CHANGE + c], &state[OFFSET_CHANGE + c]);
    }
}

// Solve the damped normal equations by Cholesky's decomposition, scaled by the diagonal.
static inline void solve(global const float *state, int size, float *step) {
    float lower[SIZE][SIZE], scale[SIZE], trace = 0.0f;
    global const float *matrix = state + MATRIX;
    for (int i = 0; i < 6; i++) trace += matrix[i * SIZE + i];
    for (int i = 0; i < size; i++) {
        float diagonal = matrix[i * SIZE + i];
        if (i < 6) diagonal += state[DAMPING] * diagonal + 1e-9f * fmax(trace, 1e-9f);
        scale[i] = rsqrt(diagonal);
        for (int j = 0; j <= i; j++) {
            float sum = i == j ? 1.0f : matrix[i * SIZE + j] * scale[i] * scale[j];
            for (int k = 0; k < j; k++) sum -= lower[i][k] * lower[j][k];
            lower[i][j] = i == j ? sqrt(fmax(sum, 1e-6f)) : sum / lower[j][j];
        }
        float sum = state[RHS + i] * scale[i];
        for (int k = 0; k < i; k++) sum -= lower[i][k] * step[k];
        step[i] = sum / lower[i][i];
    }
    for (int i = size - 1; i >= 0; i--) {
        for (int k = i + 1; k < size; k++) step[i] -= lower[k][i] * step[k];
        step[i] /= lower[i][i];
    }
    for (int i = 0; i < size; i++) step[i] *= scale[i];
}

// Index space: one work-item. Reads: the totals of a frame. Writes: the pose and the exposure of the next frame.
kernel void align_step(
//@@ arguments align_step
) {
    global const float *scalars = totals + 24 * CHANNEL_ROWS;
    if (scalars[OVERFLOW] != 0.0f) state[CONVERGED] = 2.0f;   // the frame is incomplete
    if (state[CONVERGED] != 0.0f) return;
    float count = fmax(scalars[PIXELS], 1.0f), step[SIZE];
    bool accepted = scalars[LOSS_BEFORE] / count <= state[COST];
    if (accepted) {
        accept(totals, channels, state);
        state[COST] = scalars[LOSS] / count;
        state[INVERSE_DEPTH] = scalars[SQUARED_INVERSE_DEPTHS] / count;
        state[NOISE] = scalars[NOISE_OF_FRAME];
        for (int c = 0; c < 6; c++) state[GAIN + c] = fit[c];
        for (int k = 0; k < 12; k++) pose[k] = view[k];
    }
    state[DAMPING] = accepted ? fmax(state[DAMPING] / 10.0f, 1e-6f) : state[DAMPING] * 10.0f;
    for (int c = 0; c < channels; c++) {
        fit[c] = clamp(state[GAIN + c] * state[GAIN_CHANGE + c], MIN_GAIN, MAX_GAIN);
        fit[3 + c] = state[OFFSET + c] + state[GAIN + c] * state[OFFSET_CHANGE + c];
    }
    if (state[EXPOSURE_KNOWN] == 0.0f) {   // the first sums determine the exposure alone
        state[EXPOSURE_KNOWN] = 1.0f;
        state[COST] = INFINITY;
        state[DAMPING] *= 10.0f;
    } else {
        fit[6] = state[NOISE];
        solve(state, 6 + 2 * channels, step);
        real before[12], motion[6];
        for (int k = 0; k < 12; k++) before[k] = pose[k];
        for (int k = 0; k < 6; k++) motion[k] = step[k];
        move(before, motion, view);
        float angle_square = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
        float shift_square = step[3] * step[3] + step[4] * step[4] + step[5] * step[5];
        state[CONVERGED] = focal * sqrt(angle_square + shift_square * state[INVERSE_DEPTH]) < tolerance;
    }
    for (int k = 0; k < 12; k++) state[NEXT_POSE + k] = view[k];
    for (int k = 0; k < 6; k++) state[NEXT_FIT + k] = fit[k];
}
