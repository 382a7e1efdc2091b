// As gsplat and the 2DGS authors do: the fragment that would take the transmittance to the stop or below is dropped, and
// the pixel is finished. For parity only: it leaks up to 1 % of the background through opaque splats (numerics D1).
//@ state
    vint finished;
//@ start
    pixel->finished = 0;
//@ stop
    live &= ~pixel->finished;
    vint drop = live & VMASK(pixel->t * (1.0f - opacity) <= constants->stop);
    pixel->finished |= drop;
    live &= ~drop;
//@ external_attributes
        pixel->finished = 0;
