// Values of [0, 1] as 8 bits, when somebody reads an image so: a quarter of what a copy to the host would move. Bit for bit
// `to_uint8` of fidsplat/images/files.py: clamped, rounded to the nearest, of two the even one; 0 where the value is no number.
// VALUES: of a work-item, 4 or 16.
#pragma OPENCL FP_CONTRACT OFF
#define JOINED(name, count) name##count
#define OF(name, count) JOINED(name, count)

// Index space: one work-item per VALUES values. Reads: values (count). Writes: made (count).
kernel void to_uint8(ulong count, global const float *values, global uchar *made) {
    ulong at = get_global_id(0) * (ulong)VALUES;
    if (at + VALUES <= count) {
        OF(float, VALUES) v = OF(vload, VALUES)(0, values + at);
        v = rint(fmin(fmax(v, 0.0f), 1.0f) * 255.0f);
        OF(vstore, VALUES)(OF(convert_uchar, VALUES)(v), 0, made + at);
        return;
    }
    for (; at < count; at++) made[at] = (uchar)rint(fmin(fmax(values[at], 0.0f), 1.0f) * 255.0f);
}
