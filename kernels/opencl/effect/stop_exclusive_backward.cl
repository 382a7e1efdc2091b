// A terminated pixel stays terminated in the next segment of a list: transmittance 0.
//@ transmittance
    transmittance = VSELECT(transmittance, (vfloat)0.0f, pixel->finished);
