// Several passes through a tile's list, for GPUs: until all fragments and layers of all pixels are composited.
//@ unfinished
//@@ pass_unfinished
//@ pass
    local int repeat_pass;
    do {
//@ pass_end
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item == 0) repeat_pass = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int row = 0; row < ROWS; row++)
            if (px < width && py + row < height && pass_finish(&pixels[row], splats, &constants)) repeat_pass = 1;
        barrier(CLK_LOCAL_MEM_FENCE);
        // uniform control flow: every work-item reads the same vote
    } while (repeat_pass);
