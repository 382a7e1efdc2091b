// Perspective with OpenCV's distortion: radial k1 to k6, tangential p1, p2, thin prism s1 to s4. A splat is enclosed on the
// ideal pinhole picture, which is the chart of the ray map.
//@ camera
enum { LENS = VIEW_BAND_END + 1, LENS_FOLD = LENS + 12, LENS_MAP };

// Where (x, y) = (X / Z, Y / Z) falls [samples]. Returns whether it is seen: not beyond the fold.
static inline bool lens_image(global const real *view, real x, real y, real *image_x, real *image_y) {
    global const real *k = view + LENS, *p = k + 6, *s = k + 8;
    real q = x * x + y * y;
    real radial = (1 + q * (k[0] + q * (k[1] + q * k[2]))) / (1 + q * (k[3] + q * (k[4] + q * k[5])));
    real a = x * radial + 2 * p[0] * x * y + p[1] * (q + 2 * x * x) + q * (s[0] + q * s[1]);
    real b = y * radial + p[0] * (q + 2 * y * y) + 2 * p[1] * x * y + q * (s[2] + q * s[3]);
    *image_x = view[VIEW_FX] * a + view[VIEW_CX];
    *image_y = view[VIEW_FY] * b + view[VIEW_CY];
    return q < view[LENS_FOLD];
}
//@ camera_box
    bounds = mapped_bounds(view + LENS_MAP, ray_map, bounds.ex - bounds.hx, bounds.ex + bounds.hx,
                           bounds.ey - bounds.hy, bounds.ey + bounds.hy);
    if (!(pz >= near && lens_image(view, p.x / pz, p.y / pz, &center_x, &center_y))) center_x = center_y = NAN;   // no dot of a low-pass
