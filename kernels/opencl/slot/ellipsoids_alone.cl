// Every splat is a disk that faces the camera (ellipsoid_ewa): D is 1 throughout. With others among them they are drawn with the
// same bits.
//@ footprint_cross
    c.d = 1.0f;
    c.inside = VMASK(c.q <= half_r2);
