// Termination as in gsplat and the 2DGS authors' code: the fragment that would lower the transmittance to the stop or below is
// dropped, and the pixel is terminated. For parity only: up to 1 % of the background leaks through opaque splats.
//@ state
    vint finished;
//@ start
    pixel->finished = 0;
//@ stop
    live &= ~pixel->finished;
    vint drop = live & VMASK(pixel->t * (1.0f - alpha) <= constants->transmittance_stop);
    pixel->finished |= drop;
    live &= ~drop;
//@ transmits
        & ~pixel->finished
//@ external_attributes
        pixel->finished = 0;
