// Kannala-Brandt fisheye, as in OpenCV: a ray at angle t from the axis is at distance
// t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) from the image centre. Depths are distances along the ray. The coordinates of the inverse
// lookup table (part/inverse_lens_lut.cl) are the stereographic projection (X, Y) / (|r| + Z), in which arcs of great circles are arcs of circles of radius 1 or more.
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

// Lookup table coordinates of eight points.
static inline void lut_coordinates_of(float8 x, float8 y, float8 z, float8 *lut_x, float8 *lut_y) {
    float8 across = x * x + y * y, length = sqrt(across + z * z);
    // 1 / (|r| + Z) = (|r| - Z) / (X^2 + Y^2), whichever does not cancel
    float8 scale = select(length - z, (float8)(1.0f), z > 0) / select(across, length + z, z > 0);
    *lut_x = x * scale;
    *lut_y = y * scale;
}

static inline float lowest_of(float8 x, float8 y) {
    float4 four = fmin(fmin(x.lo, x.hi), fmin(y.lo, y.hi));
    return fmin(fmin(four.x, four.y), fmin(four.z, four.w));
}

// Box of the disk in these coordinates: the corners of a polygon around it, padded by the sagitta of the arcs between them. The complete
// plane where an arc may be long or the disk may contain the pole of the projection, direction -z. Corners are vectors of float: CPUs
// compute eight at once.
static inline void lut_box(real3_ a, real3_ b, real3_ p, real radius, real away, float *box) {
    real around = radius / POLYGON_INNER;
    real3_ u = {a.x * around, a.y * around, a.z * around}, v = {b.x * around, b.y * around, b.z * around};
    // radius of the sphere around the polygon; squares are compared, so that no rounding is in the wrong direction
    real sphere = sqrt(fmax(dot3(u, u), dot3(v, v))) * REAL(1.000001);
    bool known = sphere < away && (p.z > 0 || p.x * p.x + p.y * p.y > sphere * sphere);
    // half of the corners of a 16-gon; the others are opposite
    const float8 cosine = {1, 0.92387953f, 0.70710678f, 0.38268343f, 0, -0.38268343f, -0.70710678f, -0.92387953f};
    const float8 sine = {0, 0.38268343f, 0.70710678f, 0.92387953f, 1, 0.92387953f, 0.70710678f, 0.38268343f};
    float8 dx = cosine * (float)u.x + sine * (float)v.x, dy = cosine * (float)u.y + sine * (float)v.y,
           dz = cosine * (float)u.z + sine * (float)v.z, x0, y0, x1, y1;
    float x = (float)p.x, y = (float)p.y, z = (float)p.z;
    lut_coordinates_of(x + dx, y + dy, z + dz, &x0, &y0);
    lut_coordinates_of(x - dx, y - dy, z - dz, &x1, &y1);
    float low_x = lowest_of(x0, x1), high_x = -lowest_of(-x0, -x1), low_y = lowest_of(y0, y1), high_y = -lowest_of(-y0, -y1);
    float8 x2 = (float8)(x0.s1, x0.s23, x0.s4567, x1.s0) - x0, y2 = (float8)(y0.s1, y0.s23, y0.s4567, y1.s0) - y0;
    float8 x3 = (float8)(x1.s1, x1.s23, x1.s4567, x0.s0) - x1, y3 = (float8)(y1.s1, y1.s23, y1.s4567, y0.s0) - y1;
    float longest = -lowest_of(-(x2 * x2 + y2 * y2), -(x3 * x3 + y3 * y3));
    known = known && longest < 0.25f;
    // 1 - sqrt(1 - c^2 / 4) <= c^2 / 7.5 for c <= 1/2; and a margin for rounding, here and in the per-sample test
    float size = fmax(high_x - low_x, high_y - low_y), most = fmax(fmax(-low_x, high_x), fmax(-low_y, high_y));
    float pad = longest / 7.5f + 2e-4f * size + 2e-6f * (1 + most);
    box[0] = known ? low_x - pad : -INFINITY;
    box[1] = known ? high_x + pad : INFINITY;
    box[2] = known ? low_y - pad : -INFINITY;
    box[3] = known ? high_y + pad : INFINITY;
}
//@ camera_depth
    pz = sqrt(dot3(p, p));
//@ camera_reach
    reach = radius * sqrt(fmax(dot3(a, a), dot3(b, b)));
//@ camera_bounds
    real center_x, center_y;
    float lut_bounds[4];
    lut_box(a, b, p, radius, pz, lut_bounds);
    Bounds bounds = lens_lut_bounds(view->lens_lut, inverse_lens_lut, lut_bounds[0], lut_bounds[1], lut_bounds[2], lut_bounds[3]);
    // no low-pass disc; rays of a table have no image
    if (view->lens_limit < 0 || !(pz >= near && lens_image(view, p, &center_x, &center_y))) center_x = center_y = NAN;
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
