// Perspective with OpenCV's distortion: radial k1 to k6, tangential p1, p2, thin prism s1 to s4. Splats are bounded in the
// undistorted pinhole image, whose coordinates the inverse lookup table has (part/inverse_lens_lut.cl).
//@ camera
// Projects (x, y) = (X / Z, Y / Z) [samples]. Returns false beyond the radius where the distortion folds back.
static inline bool lens_image(global const View *view, real x, real y, real *image_x, real *image_y) {
    global const real *k = view->lens, *p = k + 6, *s = k + 8;
    real q = x * x + y * y;
    real radial = (1 + q * (k[0] + q * (k[1] + q * k[2]))) / (1 + q * (k[3] + q * (k[4] + q * k[5])));
    real a = x * radial + 2 * p[0] * x * y + p[1] * (q + 2 * x * x) + q * (s[0] + q * s[1]);
    real b = y * radial + p[0] * (q + 2 * y * y) + 2 * p[1] * x * y + q * (s[2] + q * s[3]);
    *image_x = view->focal_x * a + view->center_x;
    *image_y = view->focal_y * b + view->center_y;
    return q < view->lens_fold;
}
//@ camera_box
    bounds = lens_lut_bounds(view->lens_lut, inverse_lens_lut, bounds.ex - bounds.hx, bounds.ex + bounds.hx,
                           bounds.ey - bounds.hy, bounds.ey + bounds.hy);
    if (!(pz >= near && lens_image(view, p.x / pz, p.y / pz, &center_x, &center_y))) center_x = center_y = NAN;   // no low-pass disc
//@ camera_derivative_functions
// Derivatives of the image coordinates by (x, y) = (X / Z, Y / Z): a_x, a_y, b_x, b_y.
static inline void lens_slopes(global const View *view, real x, real y, real *slopes) {
    global const real *k = view->lens, *p = k + 6, *s = k + 8;
    real q = x * x + y * y;
    real above = 1 + q * (k[0] + q * (k[1] + q * k[2])), below = 1 + q * (k[3] + q * (k[4] + q * k[5]));
    real radial = above / below;
    real steep = 2 * (k[0] + q * (2 * k[1] + q * 3 * k[2]) - radial * (k[3] + q * (2 * k[4] + q * 3 * k[5]))) / below;
    real prism_a = 2 * (s[0] + 2 * q * s[1]), prism_b = 2 * (s[2] + 2 * q * s[3]);
    real both = x * y * steep + 2 * p[0] * x + 2 * p[1] * y;
    slopes[0] = radial + x * x * steep + 2 * p[0] * y + 6 * p[1] * x + x * prism_a;
    slopes[1] = both + y * prism_a;
    slopes[2] = both + x * prism_b;
    slopes[3] = radial + y * y * steep + 6 * p[0] * y + 2 * p[1] * x + y * prism_b;
}
//@ camera_derivative
        real ahead = 1 / pz, at_x = p.x * ahead, at_y = p.y * ahead, slopes[4];
        lens_slopes(view, at_x, at_y, slopes);
        real x_u = ahead * (a.x - at_x * a.z), x_v = ahead * (b.x - at_x * b.z);
        real y_u = ahead * (a.y - at_y * a.z), y_v = ahead * (b.y - at_y * b.z);
        gx.x = view->focal_x * (slopes[0] * x_u + slopes[1] * y_u);
        gx.y = view->focal_x * (slopes[0] * x_v + slopes[1] * y_v);
        gy.x = view->focal_y * (slopes[2] * x_u + slopes[3] * y_u);
        gy.y = view->focal_y * (slopes[2] * x_v + slopes[3] * y_v);
        gz.x = a.z * ahead; gz.y = b.z * ahead;
        filtered = at_x * at_x + at_y * at_y < view->lens_fold;
