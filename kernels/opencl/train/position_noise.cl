// Position noise of MCMC densification: random steps of means, with the covariance of the splat. Counter-based random numbers: Philox 4x32-10 of
// the splat's index, the iteration and the random stream, keyed by the seed. NumPy reference: fidsplat/train/random_numbers.py.

static inline uint4 philox(uint4 c, uint k0, uint k1) {
    for (int round = 0; round < 10; round++) {
        uint4 next = {mul_hi(0xCD9E8D57u, c.z) ^ c.y ^ k0, 0xCD9E8D57u * c.z, mul_hi(0xD2511F53u, c.x) ^ c.w ^ k1, 0xD2511F53u * c.x};
        c = next;
        k0 += 0x9E3779B9u;
        k1 += 0xBB67AE85u;
    }
    return c;
}

// Index space: one work-item per splat. Reads: the other parameters. Updates: means.
kernel void add_position_noise(
//@@ arguments add_position_noise
) {
    size_t i = get_global_id(0);
    if (i >= count) return;
    uint4 counter = {(uint)i, iteration, random_stream, 0};
    float4 u = (convert_float4(philox(counter, seed_low, seed_high)) + 0.5f) * 2.3283064e-10f;
    // clamped: log(1) is 0, and log(0) infinite
    float2 radius = sqrt(-2.0f * log(clamp(u.xy, 1.2e-10f, 0.99999994f))), angle = 6.2831853f * u.zw;
    float3 sample = {radius.x * cos(angle.x), radius.y * cos(angle.y), radius.x * sin(angle.x)};
    float4 q = unit(vload4(i, quats));  // w x y z
    float w = q.x, x = q.y, y = q.z, z = q.w;
    float3 along = {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)};
    float3 across = {2.0f * (x * y - w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z + w * x)};
    float2 s = exp(vload2(0, log_scales + axes * i));
    float fade = 1.0f / (1.0f + exp(slope * (sigmoid(logits[i]) - threshold)));
    float3 offset = along * (dot(along, sample) * s.x * s.x) + across * (dot(across, sample) * s.y * s.y);
    if (axes == 3) {
        float3 outward = cross(along, across);
        float third = exp(log_scales[axes * i + 2]);
        offset += outward * (dot(outward, sample) * third * third);
    }
    vstore3(vload3(i, means) + offset * (fade * size), i, means);
}
