// Gathers resident chunks of stores into the arrays of the rendered cloud, in scene order, and transforms chunks of placed
// stores. INSTANCED: the device has float64 for the transform.
#pragma OPENCL FP_CONTRACT OFF
#if INSTANCED
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif

// Index space: (words of the largest piece, pieces). Reads: pieces (source row, target row, rows, pose or NOT_PLACED), source.
// Writes: target. words: per row.
kernel void gather(global const uint *source, global const uint4 *pieces, uint words, global uint *target) {
    uint4 piece = pieces[get_global_id(1)];
    ulong word = get_global_id(0);
    if (word >= (ulong)piece.z * words) return;
    target[(ulong)piece.y * words + word] = source[(ulong)piece.x * words + word];
}

#if INSTANCED
#define NOT_PLACED 0xffffffffu

// Bit-identical to `moved` (fidsplat/store/subset.py): sums have the same order. Words of a pose: rotation by rows, translation
// of the origin of the means, quaternion.
// Index space: (rows of the largest piece, pieces).
kernel void gather_means(
    global const float *source, global const uint4 *pieces, global const double *poses, global float *target) {
    uint4 piece = pieces[get_global_id(1)];
    uint row = get_global_id(0);
    if (row >= piece.z) return;
    global const float *from = source + (ulong)3 * (piece.x + row);
    global float *to = target + (ulong)3 * (piece.y + row);
    if (piece.w == NOT_PLACED) {
        for (int i = 0; i < 3; i++) to[i] = from[i];
        return;
    }
    global const double *pose = poses + 16 * (ulong)piece.w;
    double x = from[0], y = from[1], z = from[2];
    for (int i = 0; i < 3; i++)
        to[i] = (float)(pose[3 * i] * x + pose[3 * i + 1] * y + pose[3 * i + 2] * z + pose[9 + i]);
}

// Index space: that of gather_means.
kernel void gather_quats(
    global const float *source, global const uint4 *pieces, global const double *poses, global float *target) {
    uint4 piece = pieces[get_global_id(1)];
    uint row = get_global_id(0);
    if (row >= piece.z) return;
    global const float *from = source + (ulong)4 * (piece.x + row);
    global float *to = target + (ulong)4 * (piece.y + row);
    if (piece.w == NOT_PLACED) {
        for (int i = 0; i < 4; i++) to[i] = from[i];
        return;
    }
    global const double *rotation = poses + 16 * (ulong)piece.w + 12;
    double p = rotation[0], q = rotation[1], r = rotation[2], s = rotation[3];
    double w = from[0], a = from[1], b = from[2], c = from[3];
    to[0] = (float)(p * w - q * a - r * b - s * c);
    to[1] = (float)(p * a + q * w + r * c - s * b);
    to[2] = (float)(p * b - q * c + r * w + s * a);
    to[3] = (float)(p * c + q * b - r * a + s * w);
}
#endif
