// External RGB-D image, composited as an opaque surface: fragments at or behind its depth are discarded. The surface itself is
// composited after the last splat (part/external_depth_end.cl).
//@ state
    vfloat opaque_z;        // infinite where there is no surface
//@ pixels_start
    for (int row = 0; row < (int)(sizeof(pixels) / sizeof(pixels[0])); row++)
        for (int lane = 0; lane < LANES; lane++) {
#if LANES == 1
            int opaque_x = px, opaque_y = py + row;
            pixels[row].opaque_z
#else
            int opaque_x = x0 + LANE_X(row, lane), opaque_y = y0 + LANE_Y(row, lane);
            ((float *)&pixels[row].opaque_z)[lane]
#endif
                = opaque_x < width && opaque_y < height
                      ? external_depth[(opaque_y / SAMPLES) * (width / SAMPLES) + opaque_x / SAMPLES] : INFINITY;
        }
//@ empty
                       && false         // the surface covers all pixels
//@ occlude
    mask &= VMASK(attributes.z < pixel->opaque_z);
    if (!VANY(mask)) return;
