// Real spherical harmonics of degree SH_DEGREE, in the convention of gsplat and the 2DGS authors:
// colour = max(0, 1/2 + sum_k Y_k(direction) f_k), direction = normalised(centre - camera) in the world frame.
//@ project_args
    , global const float *restrict sh       // (n, (SH_DEGREE + 1)^2, 3)
//@ functions
#define SH_TERMS ((SH_DEGREE + 1) * (SH_DEGREE + 1))
static inline void sh_basis(real3_ d, float *y) {
    float x = (float)d.x, yy = (float)d.y, z = (float)d.z;
    y[0] = 0.28209479177387814f;
#if SH_DEGREE > 0
    y[1] = -0.48860251190291992f * yy;
    y[2] = 0.48860251190291992f * z;
    y[3] = -0.48860251190291992f * x;
#endif
#if SH_DEGREE > 1
    float xx = x * x, y2 = yy * yy, zz = z * z;
    y[4] = 1.0925484305920792f * (x * yy);
    y[5] = -1.0925484305920792f * (yy * z);
    y[6] = 0.31539156525252005f * (2.0f * zz - xx - y2);
    y[7] = -1.0925484305920792f * (x * z);
    y[8] = 0.54627421529603959f * (xx - y2);
#endif
#if SH_DEGREE > 2
    y[9] = -0.59004358992664352f * yy * (3.0f * xx - y2);
    y[10] = 2.8906114426405538f * (x * yy) * z;
    y[11] = -0.45704579946446572f * yy * (4.0f * zz - xx - y2);
    y[12] = 0.37317633259011546f * z * (2.0f * zz - 3.0f * xx - 3.0f * y2);
    y[13] = -0.45704579946446572f * x * (4.0f * zz - xx - y2);
    y[14] = 1.4453057213202769f * z * (xx - y2);
    y[15] = -0.59004358992664352f * x * (xx - 3.0f * y2);
#endif
}
//@ color
    real3_ ray = {mean.x - view[VIEW_EYE], mean.y - view[VIEW_EYE + 1], mean.z - view[VIEW_EYE + 2]};
    real length = sqrt(dot3(ray, ray));
    real inverse = length > 0 ? 1 / length : 0;
    ray.x *= inverse; ray.y *= inverse; ray.z *= inverse;
    float basis[SH_TERMS];
    sh_basis(ray, basis);
    float rgb[3] = {0.5f, 0.5f, 0.5f};
    for (int k = 0; k < SH_TERMS; k++)
        for (int c = 0; c < 3; c++)
            rgb[c] = FMA(basis[k], sh[((size_t)i * SH_TERMS + k) * 3 + c], rgb[c]);
    record.r = fmax(rgb[0], 0.0f);
    record.g = fmax(rgb[1], 0.0f);
    record.b = fmax(rgb[2], 0.0f);
