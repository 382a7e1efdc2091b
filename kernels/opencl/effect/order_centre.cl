// Alpha compositing in the order of the lists: by the depth of splat centres.
//@ blend_fragment
    composite(pixel, &attributes, alpha, mask, constants);
