// Alpha compositing in the order of the lists: by the depth of splat centres.
//@ compose
    composite(pixel, &attributes, alpha, mask, constants);
