// A low-pass that conserves energy: the splat is convolved, in its own plane, with a Gaussian of the size of a sample's
// footprint there, and its opacity falls as its area grows (EWA splatting, Zwicker et al. 2001, carried over to 2DGS). With G the
// derivative of the sample's position by (u, v) at the centre, the footprint's covariance in (u, v) is s^2 (G^T G)^-1. So the
// filtered splat is another 2D Gaussian of the same plane, and nothing after the set-up knows of the filter.
//@ functions
//@@ camera_derivative_functions
//@ lowpass_make
#ifndef BOX_HERE
#define BOX_HERE false
#endif
    bool filtered = !BOX_HERE && pz >= near;
    real3_ gx = {0, 0, 0}, gy = {0, 0, 0};   // derivatives of the sample's x, y by u, v; z is not used
    if (filtered) {
//@@ camera_derivative
    }
    if (filtered) {
        // standard deviation in samples: a point spreads over its pixels evenly to 1.5 % per axis wherever it lies between them
        const real variance = REAL(0.25);
        real m11 = gx.x * gx.x + gy.x * gy.x, m12 = gx.x * gx.y + gy.x * gy.y, m22 = gx.y * gx.y + gy.y * gy.y;
        real area = gx.x * gy.y - gx.y * gy.x, area2 = area * area;
        real grown = 1 + variance * (m11 + m22 + variance) / area2;      // (area after / area before)^2
        log_opacity -= (wide)(REAL(0.5) * log(grown));
        half_r2 = log_opacity - (wide)view->log_cut;
        if (!(half_r2 > 0.0f)) return;                                  // edge-on too: infinitely thin, infinitely faint
        real c11 = 1 + variance * m22 / area2, c12 = -variance * m12 / area2;
        real l11 = sqrt(c11), l21 = c12 / l11, l22 = sqrt(grown) / l11;    // L L^T = 1 + s^2 (G^T G)^-1
        a.x = a.x * l11 + b.x * l21; a.y = a.y * l11 + b.y * l21; a.z = a.z * l11 + b.z * l21;
        b.x *= l22; b.y *= l22; b.z *= l22;
        su *= l11;
        sv *= l22;
    }
