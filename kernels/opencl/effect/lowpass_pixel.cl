// Energy-conserving low-pass: the splat is convolved, in its own plane, with a Gaussian of the size of a sample's footprint there,
// and its opacity is reduced as its area grows (EWA splatting, Zwicker et al. 2001, applied to 2DGS). The footprint is a 3D Gaussian
// around the sample's ray with standard deviation s samples across and a share k of the depth along it; unbounded along the ray, it
// would overlap an edge-on plane far beyond where the derivative at the centre is valid. With G the 3 x 2 derivative by (u, v),
// at the centre, of the sample's position and of s / k times the logarithm of depth, its covariance in (u, v) is s^2 (G^T G)^-1.
// The filtered splat is a 2D Gaussian in the same plane, so that only the projection has code for it. For parallel rays the last row
// of G is 0.
//@ functions
//@@ camera_derivative_functions
//@ lowpass_make
#ifndef BOX_HERE
#define BOX_HERE false
#endif
    bool filtered = !BOX_HERE && pz >= near;
    // derivatives with respect to u, v of the sample's x, of its y, and of depth relative to depth; z is unused
    real3_ gx = {0, 0, 0}, gy = {0, 0, 0}, gz = {0, 0, 0};
    if (filtered) {
//@@ camera_derivative
    }
    if (filtered) {
        // standard deviation 1/2 sample: a point's energy varies by 1.5 % per axis with its position in the pixel
        const real variance = REAL(0.25);
        // s / k with s = 1/2 and k = 1/8: scale of the logarithm of depth
        const real depth = REAL(4.0);
        real du = depth * gz.x, dv = depth * gz.y;
        real m11 = gx.x * gx.x + gy.x * gy.x + du * du, m22 = gx.y * gx.y + gy.y * gy.y + dv * dv;
        real m12 = gx.x * gx.y + gy.x * gy.y + du * dv;
        // det G^T G as the sum of squared minors (Cauchy-Binet), without cancellation
        real area = gx.x * gy.y - gx.y * gy.x, along_x = gx.x * dv - gx.y * du, along_y = gy.x * dv - gy.y * du;
        real area2 = area * area + along_x * along_x + along_y * along_y;
        real grown = 1 + variance * (m11 + m22 + variance) / area2;      // (area after / area before)^2
        log_opacity -= (blend_real)(REAL(0.5) * ln(grown));
        half_r2 = log_opacity - (blend_real)view->log_alpha_cutoff;
        if (!(half_r2 > 0.0f)) return;              // also for edge-on splats under parallel rays: infinitely thin and faint
        real c11 = 1 + variance * m22 / area2, c12 = -variance * m12 / area2;
        real l11 = sqrt(c11), l21 = c12 / l11, l22 = sqrt(grown) / l11;    // L L^T = 1 + s^2 (G^T G)^-1
        a.x = a.x * l11 + b.x * l21; a.y = a.y * l11 + b.y * l21; a.z = a.z * l11 + b.z * l21;
        b.x *= l22; b.y *= l22; b.z *= l22;
        su *= l11;
        sv *= l22;
    }
