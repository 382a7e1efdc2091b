// Kannala-Brandt fisheye, as in OpenCV: a ray at angle t from the axis is at distance
// t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) from the image centre. Depths are distances along the ray. The chart of the ray map is the
// stereographic projection (X, Y) / (|r| + Z), in which arcs of great circles are arcs of circles of radius 1 or more.
//@ camera
// Projects a point [samples]. Returns false outside of the field of view.
static inline bool lens_image(global const View *view, real3_ p, real *image_x, real *image_y) {
    global const real *k = view->lens;
    real across = sqrt(p.x * p.x + p.y * p.y), angle = atan2(across, p.z), q = angle * angle;
    real distance = angle * (1 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3]))));
    real factor = across > 0 ? distance / across : 0;
    *image_x = view->focal_x * (factor * p.x) + view->center_x;
    *image_y = view->focal_y * (factor * p.y) + view->center_y;
    return angle <= view->lens_limit;
}

// Box of the disk in the chart: the corners of a polygon around it, padded by the sagitta of the arcs between them. The complete
// chart where an arc may be long or the disk may contain the pole of the chart, direction -z.
static inline void chart_box(real3_ a, real3_ b, real3_ p, real radius, real away, real *box) {
    real around = radius / POLYGON_INNER;
    box[0] = box[2] = INFINITY;
    box[1] = box[3] = -INFINITY;
    real3_ u = {a.x * around, a.y * around, a.z * around}, v = {b.x * around, b.y * around, b.z * around};
    // radius of the sphere around the polygon; squares are compared, so that no rounding is in the wrong direction
    real sphere = sqrt(fmax(dot3(u, u), dot3(v, v))) * REAL(1.000001);
    real x0 = 0, y0 = 0, longest = 0;
    bool known = sphere < away && (p.z > 0 || p.x * p.x + p.y * p.y > sphere * sphere);
    real cu = 1, cv = 0;
    for (int k = 0; k <= POLYGON && known; k++) {
        real3_ corner = {p.x + cu * u.x + cv * v.x, p.y + cu * u.y + cv * v.y, p.z + cu * u.z + cv * v.z};
        real below = sqrt(dot3(corner, corner)) + corner.z;
        real x1 = corner.x / below, y1 = corner.y / below;
        if (k > 0) longest = fmax(longest, (x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0));
        x0 = x1, y0 = y1;
        next_corner(&cu, &cv);
        box[0] = fmin(box[0], x1);
        box[1] = fmax(box[1], x1);
        box[2] = fmin(box[2], y1);
        box[3] = fmax(box[3], y1);
    }
    known = known && longest < REAL(0.25);
    // 1 - sqrt(1 - c^2 / 4) <= c^2 / 7.5 for c <= 1/2; and a margin for the rounding of the per-sample test
    real pad = longest / REAL(7.5) + REAL(2e-4) * fmax(box[1] - box[0], box[3] - box[2]) + REAL(1e-6);
    box[0] = known ? box[0] - pad : -INFINITY;
    box[1] = known ? box[1] + pad : INFINITY;
    box[2] = known ? box[2] - pad : -INFINITY;
    box[3] = known ? box[3] + pad : INFINITY;
}
//@ camera_depth
    pz = sqrt(dot3(p, p));
//@ camera_reach
    reach = radius * sqrt(fmax(dot3(a, a), dot3(b, b)));
//@ camera_bounds
    real chart[4], center_x, center_y;
    chart_box(a, b, p, radius, pz, chart);
    Bounds bounds = mapped_bounds(view->map, ray_map, chart[0], chart[1], chart[2], chart[3]);
    if (!(pz >= near && lens_image(view, p, &center_x, &center_y))) center_x = center_y = NAN;   // no low-pass disc
//@ camera_derivative
        // radial and tangential derivatives, rotated into image axes
        real across = sqrt(p.x * p.x + p.y * p.y), angle = atan2(across, p.z), q = angle * angle;
        real cosine = across > 0 ? p.x / across : 1, sine = across > 0 ? p.y / across : 0;
        global const real *k = view->lens;
        real slope = (1 + q * (3 * k[0] + q * (5 * k[1] + q * (7 * k[2] + q * 9 * k[3])))) / (pz * pz);
        real distance = angle * (1 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3]))));
        real around = across > 0 ? distance / across : 1 / p.z;
        real out_u = slope * (p.z * (cosine * a.x + sine * a.y) - across * a.z);
        real out_v = slope * (p.z * (cosine * b.x + sine * b.y) - across * b.z);
        real round_u = around * (cosine * a.y - sine * a.x), round_v = around * (cosine * b.y - sine * b.x);
        gx.x = view->focal_x * (cosine * out_u - sine * round_u);
        gx.y = view->focal_x * (cosine * out_v - sine * round_v);
        gy.x = view->focal_y * (sine * out_u + cosine * round_u);
        gy.y = view->focal_y * (sine * out_v + cosine * round_v);
        gz.x = dot3(p, a) / (pz * pz); gz.y = dot3(p, b) / (pz * pz);
        filtered = angle <= view->lens_limit;
//@ camera_box_reach
        reach = su + sv;
//@ camera_ellipsoid_reach
        reach = radius * sqrt(dot3(a, a) + dot3(b, b) + dot3(third, third));
