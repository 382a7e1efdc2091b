// Exponentials, logarithms and divisions of the device's library.
//@ opacity
    return fmin(exp(s->log_opacity - half_rho), (vfloat)ceiling);
//@ reciprocal
    vfloat inverse_d = 1.0f / c.d;
//@ layer_tau
    vfloat tau = -log(fmax(1.0f - opacity, (vfloat)0x1p-24f));
