// Every splat is a disk that faces the camera, whose first half axis' image is the only one that has columns (ellipsoid_ewa): D is 1
// throughout, and n_u has no part of rows. With others among them they are drawn with the same bits.
//@ footprint_cross
    c.d = 1.0f;
    c.q = FMA(nu_x, nu_x, nv * nv);
    c.inside = VMASK(c.q <= half_r2);
