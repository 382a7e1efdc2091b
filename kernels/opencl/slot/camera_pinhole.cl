// Pinhole camera, OpenCV axes.
//@ camera_forms
    tu = image_row(view->focal_x, view->center_x - anchor_x, row_x, tw);
    tv = image_row(view->focal_y, view->center_y - anchor_y, row_y, tw);
    real3_ k0 = cross3(tu, tv), kx = cross3(tv, tw), ky = cross3(tw, tu);   // (n_u, n_v, D): constant, per x, per y
    real determinant = view->focal_x * view->focal_y * su * sv * offset;   // of M: exact where tw . k0 cancels
//@ camera_dot
        // The dot is never the larger weight of a splat that is wider than it wherever the dot reaches: there D is at least
        // `least`, in front of the near plane, and (n_u^2 + n_v^2) / D^2 at most the squared distance.
        real spread = sqrt((kx.z * kx.z + ky.z * ky.z) * (half_r2 / view->filter));
        real ahead = (k0.z + kx.z * (center_x - anchor_x) + ky.z * (center_y - anchor_y)) * (determinant < 0 ? -1 : 1);
        real least = ahead - spread, steep = kx.x * kx.x + kx.y * kx.y + ky.x * ky.x + ky.y * ky.y;
        // a margin for the rounding of the record's float32
        if (facing != 0 && least > 0 && (ahead + spread) * near < REAL(0.999) * fabs(determinant) &&
            steep < REAL(1.99) * view->filter * least * least)
            record.dot_x = 1e18f;
//@ camera_derivative
        real ahead = 1 / pz;
        real3_ in_x = {a.x, b.x, p.x}, in_y = {a.y, b.y, p.y}, in_z = {a.z, b.z, p.z};
        gx = image_row(view->focal_x * ahead, -view->focal_x * p.x * ahead * ahead, in_x, in_z);
        gy = image_row(view->focal_y * ahead, -view->focal_y * p.y * ahead * ahead, in_y, in_z);
