// Several passes through a tile's list, for CPUs: until all fragments and layers of all pixels are composited.
//@ pass
    do {
//@ pass_end
        alive = 0;
        for (int block = 0; block < BLOCKS; block++)
            if ((in_image >> block & 1u) && VANY(pass_finish(&pixels[block], splats, &constants))) alive |= 1u << block;
    } while (alive);
