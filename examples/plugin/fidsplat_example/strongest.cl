// strongest (h, w): largest weight of a fragment; 0 if there is none.
//@ state
    vfloat strongest;
//@ start
    pixel->strongest = 0.0f;
//@ composite
    pixel->strongest = fmax(pixel->strongest, VSELECT((vfloat)0.0f, weight, live));
//@ store
        BLOCK_STORE(pixel->strongest, strongest_raw + at, stride);
//@ resolve_start
    float strongest = 0.0f;
//@ resolve_sample
            strongest = fmax(strongest, strongest_raw[at]);
//@ resolve_end
    strongest_out[out] = strongest;
