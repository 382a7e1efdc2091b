// A step of Levenberg-Marquardt for direct image alignment. NumPy version: `_minimise` in fidsplat/localisation/direct_alignment.py.
#define CHANNEL_ROWS 10
#define SIZE 12   // unknowns of three channels: pose (6), then gain and offset of each channel

// Layout of `state`: pose and exposure of the next frame; the estimate at the last accepted pose, with its normal equations.
enum { SETTLED, NOISE, NEXT_POSE, NEXT_FIT = NEXT_POSE + 12, COST = NEXT_FIT + 6, DAMPING, INVERSE_DEPTH, EXPOSED, GAIN, OFFSET = GAIN + 3, GAINS = OFFSET + 3, OFFSETS = GAINS + 3,
       RIGHT = OFFSETS + 3, MATRIX = RIGHT + SIZE };

// Exposure changes of a channel that equalise mean and standard deviation of the blurred images. m: the channel's sums.
static inline void exposure_of(global const float *m, float squares, global float *gain, global float *offset) {
    float count = m[63], value = m[55] / count, residual = m[71] / count;
    float variance = fmax(m[54] / count - value * value, 1e-12f), mixed = m[70] / count - value * residual;
    float image = variance + 2.0f * mixed + squares / count - residual * residual;
    *gain = sqrt(fmax(image, 1e-12f) / variance);
    *offset = value + residual - *gain * value;
}

// Store the normal equations of the totals, and the changes of exposure.
static inline void accept(global const float *totals, int channels, global float *state) {
    global float *matrix = state + MATRIX;
    for (int k = 0; k < SIZE * SIZE; k++) matrix[k] = 0.0f;
    for (int k = 0; k < SIZE; k++) state[RIGHT + k] = 0.0f;
    for (int c = 0; c < channels; c++) {
        global const float *m = totals + c * 8 * CHANNEL_ROWS;
        for (int i = 0; i < 8; i++) {
            int row = i < 6 ? i : i + 2 * c;
            state[RIGHT + row] += m[64 + i];
            for (int j = 0; j < 8; j++) matrix[row * SIZE + (j < 6 ? j : j + 2 * c)] += m[8 * i + j];
        }
        for (int i = 6 + 2 * c; i < 8 + 2 * c; i++) matrix[i * SIZE + i] += 1e-9f * (1.0f + m[54] + m[63]);
        exposure_of(m, totals[24 * CHANNEL_ROWS + c], &state[GAINS + c], &state[OFFSETS + c]);
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
        float sum = state[RIGHT + i] * scale[i];
        for (int k = 0; k < i; k++) sum -= lower[i][k] * step[k];
        step[i] = sum / lower[i][i];
    }
    for (int i = size - 1; i >= 0; i--) {
        for (int k = i + 1; k < size; k++) step[i] -= lower[k][i] * step[k];
        step[i] /= lower[i][i];
    }
    for (int i = 0; i < size; i++) step[i] *= scale[i];
}

// Set the view to the pose after a motion: rotation vector and translation in camera axes.
static inline void move(global const real *pose, const float *motion, global real *view) {
    real x = motion[0], y = motion[1], z = motion[2], square = x * x + y * y + z * z, angle = sqrt(square);
    real one = angle > REAL(1e-4) ? sin(angle) / angle : 1 - square / 6;
    real two = angle > REAL(1e-4) ? (1 - cos(angle)) / square : REAL(0.5) - square / 24;
    real turn[9] = {1 - two * (y * y + z * z), two * x * y - one * z, two * x * z + one * y,
                    two * x * y + one * z, 1 - two * (x * x + z * z), two * y * z - one * x,
                    two * x * z - one * y, two * y * z + one * x, 1 - two * (x * x + y * y)};
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            view[3 * i + j] = turn[3 * i] * pose[j] + turn[3 * i + 1] * pose[3 + j] + turn[3 * i + 2] * pose[6 + j];
        view[9 + i] = turn[3 * i] * pose[9] + turn[3 * i + 1] * pose[10] + turn[3 * i + 2] * pose[11] + motion[3 + i];
    }
    for (int j = 0; j < 3; j++) view[12 + j] = -(view[j] * view[9] + view[3 + j] * view[10] + view[6 + j] * view[11]);
}

// Index space: one work-item. Reads: the totals of a frame. Writes: the pose and the exposure of the next frame.
kernel void align_step(
//@@ arguments align_step
) {
    global const float *scalars = totals + 24 * CHANNEL_ROWS;
    if (scalars[9] != 0.0f) state[SETTLED] = 2.0f;   // the frame is incomplete
    if (state[SETTLED] != 0.0f) return;
    float count = fmax(scalars[3], 1.0f), step[SIZE];
    bool accepted = scalars[5] / count <= state[COST];
    if (accepted) {
        accept(totals, channels, state);
        state[COST] = scalars[4] / count;
        state[INVERSE_DEPTH] = scalars[6] / count;
        state[NOISE] = scalars[8];
        for (int c = 0; c < 6; c++) state[GAIN + c] = fit[c];
        for (int k = 0; k < 12; k++) pose[k] = view[k];
    }
    state[DAMPING] = accepted ? fmax(state[DAMPING] / 10.0f, 1e-6f) : state[DAMPING] * 10.0f;
    for (int c = 0; c < channels; c++) {
        fit[c] = clamp(state[GAIN + c] * state[GAINS + c], MIN_GAIN, MAX_GAIN);
        fit[3 + c] = state[OFFSET + c] + state[GAIN + c] * state[OFFSETS + c];
    }
    if (state[EXPOSED] == 0.0f) {   // the first sums determine the exposure alone
        state[EXPOSED] = 1.0f;
        state[COST] = INFINITY;
        state[DAMPING] *= 10.0f;
    } else {
        fit[6] = state[NOISE];
        solve(state, 6 + 2 * channels, step);
        move(pose, step, view);
        float turn = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
        float shift = step[3] * step[3] + step[4] * step[4] + step[5] * step[5];
        state[SETTLED] = focal * sqrt(turn + shift * state[INVERSE_DEPTH]) < settled;
    }
    for (int k = 0; k < 12; k++) state[NEXT_POSE + k] = view[k];
    for (int k = 0; k < 6; k++) state[NEXT_FIT + k] = fit[k];
}
