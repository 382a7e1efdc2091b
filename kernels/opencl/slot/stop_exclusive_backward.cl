// A pixel that is finished stays so from one chunk of a list to the next: no light goes on.
//@ transmittance
    transmittance = VSELECT(transmittance, (vfloat)0.0f, pixel->finished);
