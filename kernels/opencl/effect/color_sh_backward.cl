// Spherical harmonics: gradients with respect to the coefficients and, through the direction, the centre and the camera's position.
//@ functions
#define IS_RGB 0
#define CLOUD_COEFFICIENTS sh
#define GRAD_COEFFICIENTS grad_sh
// Gradient of sum_k by[k] Y_k with respect to the direction.
static inline real3_ sh_basis_backward(real3_ d, const blend_real *by) {
    blend_real x = (blend_real)d.x, y = (blend_real)d.y, z = (blend_real)d.z, grad_x = 0.0f, grad_y = 0.0f, grad_z = 0.0f;
#if SH_DEGREE > 0
    const blend_real c1 = BLEND_REAL(0.48860251190291992);
    grad_x -= c1 * by[3];
    grad_y -= c1 * by[1];
    grad_z += c1 * by[2];
#endif
#if SH_DEGREE > 1
    const blend_real c2 = BLEND_REAL(1.0925484305920792), c20 = BLEND_REAL(0.31539156525252005), c22 = BLEND_REAL(0.54627421529603959);
    grad_x += c2 * (y * by[4] - z * by[7]) - 2.0f * c20 * x * by[6] + 2.0f * c22 * x * by[8];
    grad_y += c2 * (x * by[4] - z * by[5]) - 2.0f * c20 * y * by[6] - 2.0f * c22 * y * by[8];
    grad_z += -c2 * (y * by[5] + x * by[7]) + 4.0f * c20 * z * by[6];
#endif
#if SH_DEGREE > 2
    const blend_real c33 = BLEND_REAL(0.59004358992664352), c32 = BLEND_REAL(2.8906114426405538), c31 = BLEND_REAL(0.45704579946446572);
    const blend_real c30 = BLEND_REAL(0.37317633259011546), c34 = BLEND_REAL(1.4453057213202769);
    blend_real xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
    grad_x += -6.0f * c33 * xy * by[9] + c32 * yz * by[10] + 2.0f * c31 * xy * by[11] - 6.0f * c30 * xz * by[12];
    grad_x += -c31 * (4.0f * zz - 3.0f * xx - yy) * by[13] + 2.0f * c34 * xz * by[14] - 3.0f * c33 * (xx - yy) * by[15];
    grad_y += -3.0f * c33 * (xx - yy) * by[9] + c32 * xz * by[10] - c31 * (4.0f * zz - xx - 3.0f * yy) * by[11];
    grad_y += -6.0f * c30 * yz * by[12] + 2.0f * c31 * xy * by[13] - 2.0f * c34 * yz * by[14] + 6.0f * c33 * xy * by[15];
    grad_z += c32 * xy * by[10] - 8.0f * c31 * yz * by[11] + c30 * (6.0f * zz - 3.0f * xx - 3.0f * yy) * by[12];
    grad_z += -8.0f * c31 * xz * by[13] + c34 * (xx - yy) * by[14];
#endif
    real3_ slope = {grad_x, grad_y, grad_z};
    return slope;
}
//@ color_backward
    {
        real3_ ray = {means[3 * i] - view->eye[0], means[3 * i + 1] - view->eye[1], means[3 * i + 2] - view->eye[2]};
        real length = sqrt(dot3(ray, ray)), inverse = length > 0 ? 1 / length : 0;
        ray = scaled(inverse, ray);
        sh_basis(ray, splat_grad.basis);
        // colours below 0 are clamped and have no gradient
        const Splat s = splats[i];
        splat_grad.color[0] = s.r > 0.0f ? (float)total.r : 0.0f;
        splat_grad.color[1] = s.g > 0.0f ? (float)total.g : 0.0f;
        splat_grad.color[2] = s.b > 0.0f ? (float)total.b : 0.0f;
        blend_real grad_basis[SH_COEFFICIENTS];
        for (int k = 0; k < SH_COEFFICIENTS; k++) {
            global const float *term = coefficients + ((size_t)i * row + k) * 3;
            grad_basis[k] = splat_grad.color[0] * term[0] + splat_grad.color[1] * term[1] + splat_grad.color[2] * term[2];
        }
        real3_ slope = sh_basis_backward(ray, grad_basis);
        grad_ray = scaled(inverse, add3(slope, scaled(-dot3(slope, ray), ray)));
    }
