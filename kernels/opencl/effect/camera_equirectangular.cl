// Equirectangular panorama: x is the longitude atan2(X, Z), y the latitude. Depths are distances along the ray. A splat is bounded
// by a cone about the direction of its centre; at a pole or the seam the bounds are full rows.
//@ camera
// Box [samples] around the projected polygon of the disk.
static inline Bounds cone_bounds(global const View *view, real3_ a, real3_ b, real3_ p, real radius, real longitude,
                                 real latitude) {
    real pi = REAL(3.14159265358979323846), around = radius / POLYGON_INNER, widest = 0, cu = around, cv = 0;
    bool known = true;
    for (int k = 0; k < POLYGON; k++) {
        real3_ corner = {p.x + cu * a.x + cv * b.x, p.y + cu * a.y + cv * b.y, p.z + cu * a.z + cv * b.z};
        real3_ aside = cross3(p, corner);
        real along = dot3(p, corner);
        known = known && along > 0;
        widest = fmax(widest, dot3(aside, aside) / (along * along));
        next_corner(&cu, &cv);
    }
    // margin for the rounding of rays and of the per-sample test
    real cone = known ? atan(sqrt(widest)) * REAL(1.0002) + REAL(1e-6) : pi;
    real low = latitude - cone, high = latitude + cone, across = pi;
    if (low > -pi / 2 && high < pi / 2) {
        across = asin(fmin(sin(cone) / cos(latitude), REAL(1.0))) * REAL(1.0002) + REAL(1e-6);
        if (longitude - across < -pi || longitude + across > pi) across = pi;
    }
    bool round = across >= pi;
    real west = round ? -pi : longitude - across, east = round ? pi : longitude + across;
    return box_bounds(view->focal_x * west + view->center_x, view->focal_x * east + view->center_x,
                      view->focal_y * low + view->center_y, view->focal_y * high + view->center_y);
}
//@ camera_depth
    pz = sqrt(dot3(p, p));
//@ camera_reach
    reach = radius * sqrt(fmax(dot3(a, a), dot3(b, b)));
//@ camera_bounds
    real longitude = atan2(p.x, p.z), latitude = atan2(p.y, sqrt(p.x * p.x + p.z * p.z));
    Bounds bounds = cone_bounds(view, a, b, p, radius, longitude, latitude);
    real center_x = view->focal_x * longitude + view->center_x, center_y = view->focal_y * latitude + view->center_y;
    if (!(pz >= near)) center_x = center_y = NAN;   // no low-pass disc
//@ camera_derivative
        real polar = p.x * p.x + p.z * p.z < REAL(1e-12) * pz * pz ? 1 : 0;   // at a pole, where longitude is discontinuous
        real around_x = polar > 0 ? 0 : p.x, around_z = polar > 0 ? REAL(1e-6) * pz : p.z;
        real flat = sqrt(around_x * around_x + around_z * around_z);
        real across = view->focal_x / (flat * flat), up = view->focal_y / (pz * pz);
        real sink = p.y / flat;
        gx.x = across * (around_z * a.x - around_x * a.z);
        gx.y = across * (around_z * b.x - around_x * b.z);
        gy.x = up * (flat * a.y - sink * (around_x * a.x + around_z * a.z));
        gy.y = up * (flat * b.y - sink * (around_x * b.x + around_z * b.z));
        gz.x = dot3(p, a) / (pz * pz); gz.y = dot3(p, b) / (pz * pz);
//@ camera_box_reach
        reach = su + sv;
//@ camera_ellipsoid_reach
        reach = radius * sqrt(dot3(a, a) + dot3(b, b) + dot3(third, third));
