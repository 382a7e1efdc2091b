// Factors of the three channels.
//@ resolve_end
    vstore3(vload3(out, rgb_out) * (float3)(red, green, blue), out, rgb_out);
