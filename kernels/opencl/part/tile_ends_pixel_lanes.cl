// The end of part/tile_ends_pixel.cl, for CPUs.
//@ pass_end
    vfloat furthest = -INFINITY;
    for (int block = 0; block < BLOCKS; block++)
        if (on_picture >> block & 1u) furthest = fmax(furthest, pixel_end(&pixels[block], &constants));
    float ends[LANES];
    VSTORE(furthest, ends);
    for (int lane = 1; lane < LANES; lane++) ends[0] = fmax(ends[0], ends[lane]);
    tile_ends[tile] = on_picture ? sortable(ends[0]) : UINT_MAX;
