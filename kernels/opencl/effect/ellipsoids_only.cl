// Clouds of EWA-projected 3D Gaussians only: all splats are disks that face the camera, with D = 1 and n_u independent of rows.
// Bit-identical to the general code.
//@ footprint
#define INVERSE_D(c) 1.0f
#define HALF_RHO(c, inverse_d) ((c).q)
//@ footprint_intersect
    c.d = 1.0f;
    c.q = FMA(nu_x, nu_x, nv * nv);
    c.inside = VMASK(c.q <= half_r2);
