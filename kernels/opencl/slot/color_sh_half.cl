// Spherical harmonics (slot/sh_terms.cl), held in half precision.
//@ project_args
    , global const half *restrict sh_half   // (n, (SH_DEGREE + 1)^2, 3)
//@ sh_term
            rgb[c] = FMA(basis[k], (wide)vload_half(((size_t)i * SH_TERMS + k) * 3 + c, sh_half), rgb[c]);
