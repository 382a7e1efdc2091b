// Maximum over the tile's pixels of part/termination_depth_pixel.cl, for GPUs.
//@ group_start
    local uint furthest;
    if (item == 0) furthest = 0;
//@ pass_end
    for (int row = 0; row < ROWS; row++)
        if (px < width && py + row < height)
            atomic_max(&furthest, sortable(convert_float_rtp(pixel_termination(&pixels[row], &constants))));
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) termination_depths[tile] = furthest;
