// Spherical harmonics (slot/sh_terms.cl), held in single precision.
//@ project_args
    , global const float *restrict sh       // (n, (SH_DEGREE + 1)^2, 3)
//@ sh_term
            rgb[c] = FMA(basis[k], (wide)sh[((size_t)i * SH_TERMS + k) * 3 + c], rgb[c]);
