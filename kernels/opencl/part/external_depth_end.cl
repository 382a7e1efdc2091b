// Composites the surface of the external depth image with the remaining transmittance, however low, after the last splat.
//@ pass_end
    const BlendConstants unstopped = {log_alpha_cutoff, opacity_ceiling, -1.0f, sample_area};
    for (int row = 0; row < (int)(sizeof(pixels) / sizeof(pixels[0])); row++) {
        Pixel *pixel = &pixels[row];
        vint mask = VMASK(pixel->opaque_z < INFINITY);
        if (!VANY(mask)) continue;
        Attributes attributes;
        attributes.z = VSELECT((vfloat)0.0f, pixel->opaque_z, mask);
        for (int lane = 0; lane < LANES; lane++) {
#if LANES == 1
            int opaque_x = min(px, width - 1), opaque_y = min(py + row, height - 1);
#define OPAQUE(type, of) of
#else
            int opaque_x = min(x0 + LANE_X(row, lane), width - 1), opaque_y = min(y0 + LANE_Y(row, lane), height - 1);
#define OPAQUE(type, of) ((type *)&(of))[lane]
#endif
            size_t at = (size_t)(opaque_y / SAMPLES) * (width / SAMPLES) + opaque_x / SAMPLES;
            OPAQUE(float, attributes.r) = external_rgb[3 * at];
            OPAQUE(float, attributes.g) = external_rgb[3 * at + 1];
            OPAQUE(float, attributes.b) = external_rgb[3 * at + 2];
//@@ external_lane
        }
//@@ external_attributes
        composite(pixel, &attributes, (vfloat)1.0f, mask, &unstopped);
    }
