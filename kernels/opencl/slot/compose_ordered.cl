// The paper's compositing formula: every fragment over what lies behind it, in depth order.
//@ live
    vint live = mask & VMASK(pixel->t > constants->stop);
//@ compose
    pixel->r = FMA(weight, (vfloat)s->r, pixel->r);
    pixel->g = FMA(weight, (vfloat)s->g, pixel->g);
    pixel->b = FMA(weight, (vfloat)s->b, pixel->b);
//@ unfinished
    return VMASK(pixel->t > constants->stop);
