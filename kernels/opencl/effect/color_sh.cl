// Real spherical harmonics of degree SH_DEGREE, in the convention of gsplat and the 2DGS authors:
// colour = max(0, 1/2 + sum_k Y_k(direction) f_k), direction = normalised(centre - camera) in the world frame.
//@ functions
#define SH_COEFFICIENTS ((SH_DEGREE + 1) * (SH_DEGREE + 1))
static inline void sh_basis(real3_ d, blend_real *y) {
    blend_real x = (blend_real)d.x, yy = (blend_real)d.y, z = (blend_real)d.z;
    y[0] = BLEND_REAL(0.28209479177387814);
#if SH_DEGREE > 0
    y[1] = -BLEND_REAL(0.48860251190291992) * yy;
    y[2] = BLEND_REAL(0.48860251190291992) * z;
    y[3] = -BLEND_REAL(0.48860251190291992) * x;
#endif
#if SH_DEGREE > 1
    blend_real xx = x * x, y2 = yy * yy, zz = z * z;
    y[4] = BLEND_REAL(1.0925484305920792) * (x * yy);
    y[5] = -BLEND_REAL(1.0925484305920792) * (yy * z);
    y[6] = BLEND_REAL(0.31539156525252005) * (2.0f * zz - xx - y2);
    y[7] = -BLEND_REAL(1.0925484305920792) * (x * z);
    y[8] = BLEND_REAL(0.54627421529603959) * (xx - y2);
#endif
#if SH_DEGREE > 2
    y[9] = -BLEND_REAL(0.59004358992664352) * yy * (3.0f * xx - y2);
    y[10] = BLEND_REAL(2.8906114426405538) * (x * yy) * z;
    y[11] = -BLEND_REAL(0.45704579946446572) * yy * (4.0f * zz - xx - y2);
    y[12] = BLEND_REAL(0.37317633259011546) * z * (2.0f * zz - 3.0f * xx - 3.0f * y2);
    y[13] = -BLEND_REAL(0.45704579946446572) * x * (4.0f * zz - xx - y2);
    y[14] = BLEND_REAL(1.4453057213202769) * z * (xx - y2);
    y[15] = -BLEND_REAL(0.59004358992664352) * x * (xx - 3.0f * y2);
#endif
}
//@ color
    real3_ ray = {mean.x - view->eye[0], mean.y - view->eye[1], mean.z - view->eye[2]};
    real length = sqrt(dot3(ray, ray));
    real inverse = length > 0 ? 1 / length : 0;
    ray.x *= inverse; ray.y *= inverse; ray.z *= inverse;
    blend_real basis[SH_COEFFICIENTS];
    sh_basis(ray, basis);
    blend_real rgb[3] = {0.5f, 0.5f, 0.5f};
    for (int k = 0; k < SH_COEFFICIENTS; k++)
        for (int c = 0; c < 3; c++)
            rgb[c] = FMA(basis[k], (blend_real)sh[((size_t)i * SH_COEFFICIENTS + k) * 3 + c], rgb[c]);
    record.r = fmax(rgb[0], BLEND_REAL(0.0));
    record.g = fmax(rgb[1], BLEND_REAL(0.0));
    record.b = fmax(rgb[2], BLEND_REAL(0.0));
