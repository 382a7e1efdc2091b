// Gathers resident chunks of stores into the arrays of the rendered cloud, in scene order, and transforms chunks of posed
// stores. APPLIES_POSES: the device has float64 for the transform.
#pragma OPENCL FP_CONTRACT OFF
#if APPLIES_POSES
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif

// Index space: (words of the largest copy, copies). Reads: copies (source row, target row, rows, pose or NO_POSE), source.
// Writes: target. words: number of words of a row.
kernel void gather(global const uint *source, global const uint4 *copies, uint words, global uint *target) {
    uint4 copy = copies[get_global_id(1)];
    ulong word = get_global_id(0);
    if (word >= (ulong)copy.z * words) return;
    target[(ulong)copy.y * words + word] = source[(ulong)copy.x * words + word];
}

#if APPLIES_POSES
#define NO_POSE 0xffffffffu

// A row of means (width 3) or quaternions (width 4). Bit-identical to `transformed` (fidsplat/store/partial_cloud.py): sums have the same
// order. Words of a pose: rotation by rows, translation of the origin of the means, quaternion.
// Index space: (rows of the largest copy, copies).
kernel void gather_posed(
    global const float *source, global const uint4 *copies, uint width, global const double *poses, global float *target) {
    uint4 copy = copies[get_global_id(1)];
    uint row = get_global_id(0);
    if (row >= copy.z) return;
    global const float *from = source + (ulong)width * (copy.x + row);
    global float *to = target + (ulong)width * (copy.y + row);
    if (copy.w == NO_POSE) {
        for (uint i = 0; i < width; i++) to[i] = from[i];
        return;
    }
    global const double *pose = poses + 16 * (ulong)copy.w;
    if (width == 3) {
        double x = from[0], y = from[1], z = from[2];
        for (int i = 0; i < 3; i++)
            to[i] = (float)(pose[3 * i] * x + pose[3 * i + 1] * y + pose[3 * i + 2] * z + pose[9 + i]);
        return;
    }
    double p = pose[12], q = pose[13], r = pose[14], s = pose[15];
    double w = from[0], a = from[1], b = from[2], c = from[3];
    to[0] = (float)(p * w - q * a - r * b - s * c);
    to[1] = (float)(p * a + q * w + r * c - s * b);
    to[2] = (float)(p * b - q * c + r * w + s * a);
    to[3] = (float)(p * c + q * b - r * a + s * w);
}
#endif
