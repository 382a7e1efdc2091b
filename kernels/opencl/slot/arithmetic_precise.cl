// Exponential and logarithm of the device's library.
//@ opacity
    return VMIN(exp(s->log_opacity - half_rho), (vfloat)ceiling);
//@ layer_tau
    vfloat tau = -log(fmax(1.0f - opacity, (vfloat)0x1p-24f));
