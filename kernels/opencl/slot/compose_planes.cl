// Splats that are printed on one plane (same id >= 0) have no order: where they meet in a pixel they are one layer.
// Cutting each into ever thinner sheets and shuffling the sheets gives the limit that does not depend on the order:
// optical depths tau = -ln(1 - opacity) add up, and the layer's colour is the mean of the colours weighted by tau.
// So a marker does not change when its splats are re-ordered or when a turning camera re-orders their centres (numerics C1).
// A run is what one pixel sees of one plane until a fragment of something else follows; its colour is laid down
// when it ends. Splats of no plane (-1) are composited as ever.
//@ record
    int plane;
//@ project_args
    , global const int *restrict planes      // (n)
//@ project
    record.plane = planes[i];
//@ state
    vint run;                // plane of the open run; -1: none
    vfloat front;            // transmittance where the run began
    vfloat ink;              // sum of optical depths of the run
    vfloat ink_r, ink_g, ink_b;
//@ start
    pixel->run = -1;
    pixel->front = 1.0f;
    pixel->ink = 0.0f;
    pixel->ink_r = 0.0f;
    pixel->ink_g = 0.0f;
    pixel->ink_b = 0.0f;
//@ compose_functions
// Lays down the colour of the runs where `ends` is set.
static inline void end_run(Pixel *pixel, vint ends) {
    vfloat share = VSELECT((vfloat)0.0f, (pixel->front - pixel->t) / pixel->ink, ends & VMASK(pixel->ink > 0.0f));
    pixel->r = FMA(share, pixel->ink_r, pixel->r);
    pixel->g = FMA(share, pixel->ink_g, pixel->g);
    pixel->b = FMA(share, pixel->ink_b, pixel->b);
    pixel->run = VSELECT(pixel->run, (vint)-1, ends);
    pixel->front = VSELECT(pixel->front, pixel->t, ends);
    pixel->ink = VSELECT(pixel->ink, (vfloat)0.0f, ends);
    pixel->ink_r = VSELECT(pixel->ink_r, (vfloat)0.0f, ends);
    pixel->ink_g = VSELECT(pixel->ink_g, (vfloat)0.0f, ends);
    pixel->ink_b = VSELECT(pixel->ink_b, (vfloat)0.0f, ends);
}
//@ live
    vint begins = mask & VMASK(pixel->run != (vint)s->plane);
    vint open = begins & VMASK(pixel->run >= 0);
    if (VANY(open)) end_run(pixel, open);
    // all of a run is drawn if its first fragment is: what stops it may not depend on the order within
    vint live = mask & VMASK(pixel->front > constants->stop);
//@ compose
    if (s->plane < 0) {
        pixel->r = FMA(weight, (vfloat)s->r, pixel->r);
        pixel->g = FMA(weight, (vfloat)s->g, pixel->g);
        pixel->b = FMA(weight, (vfloat)s->b, pixel->b);
        pixel->front = pixel->front - weight;
    } else {
        // an opaque fragment has the optical depth at which float32 leaves no light
        vfloat tau = -log(fmax(1.0f - opacity, (vfloat)0x1p-24f));
        pixel->run = VSELECT(pixel->run, (vint)s->plane, live);
        pixel->ink += tau;
        pixel->ink_r = FMA(tau, (vfloat)s->r, pixel->ink_r);
        pixel->ink_g = FMA(tau, (vfloat)s->g, pixel->ink_g);
        pixel->ink_b = FMA(tau, (vfloat)s->b, pixel->ink_b);
    }
//@ unfinished
    return VMASK(pixel->front > constants->stop);
//@ finish
    end_run(pixel, VMASK(pixel->run >= 0));
