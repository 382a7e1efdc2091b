// Conversion of an image from float to 8 bits on the device, which quarters the copy to the host. Bit-identical to `to_uint8` of
// fidsplat/images/files.py: clamped to [0, 1], rounded half to even; NaN becomes 0. VALUES: per work-item, 4 or 16.
#pragma OPENCL FP_CONTRACT OFF
#define JOINED(name, count) name##count
#define OF(name, count) JOINED(name, count)

// Index space: one work-item per VALUES values. Reads: values (first + count), from `first` on. Writes:
// result (count).
kernel void to_uint8(ulong count, ulong first, global const float *values, global uchar *result) {
    values += first;
    ulong at = get_global_id(0) * (ulong)VALUES;
    if (at + VALUES <= count) {
        OF(float, VALUES) v = OF(vload, VALUES)(0, values + at);
        v = rint(fmin(fmax(v, 0.0f), 1.0f) * 255.0f);
        OF(vstore, VALUES)(OF(convert_uchar, VALUES)(v), 0, result + at);
        return;
    }
    for (; at < count; at++) result[at] = (uchar)rint(fmin(fmax(values[at], 0.0f), 1.0f) * 255.0f);
}
