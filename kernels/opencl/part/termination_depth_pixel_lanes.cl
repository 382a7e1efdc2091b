// Maximum over the tile's pixels of part/termination_depth_pixel.cl, for CPUs.
//@ pass_end
    vfloat furthest = -INFINITY;
    for (int block = 0; block < BLOCKS; block++)
        if (in_image >> block & 1u) furthest = fmax(furthest, pixel_termination(&pixels[block], &constants));
    float lane_depths[LANES];
    VSTORE(furthest, lane_depths);
    for (int lane = 1; lane < LANES; lane++) lane_depths[0] = fmax(lane_depths[0], lane_depths[lane]);
    termination_depths[tile] = in_image ? sortable(lane_depths[0]) : UINT_MAX;
