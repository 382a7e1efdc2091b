// Pinhole camera, OpenCV axes.
//@ camera_forms
    tu = image_row(view[VIEW_FX], view[VIEW_CX] - anchor_x, row_x, tw);
    tv = image_row(view[VIEW_FY], view[VIEW_CY] - anchor_y, row_y, tw);
    real3_ k0 = cross3(tu, tv), kx = cross3(tv, tw), ky = cross3(tw, tu);   // (n_u, n_v, D): constant, per x, per y
    real determinant = view[VIEW_FX] * view[VIEW_FY] * su * sv * offset;   // of M: exact where tw . k0 cancels
//@ camera_derivative
        real ahead = 1 / pz;
        real3_ in_x = {a.x, b.x, p.x}, in_y = {a.y, b.y, p.y}, in_z = {a.z, b.z, p.z};
        gx = image_row(view[VIEW_FX] * ahead, -view[VIEW_FX] * p.x * ahead * ahead, in_x, in_z);
        gy = image_row(view[VIEW_FY] * ahead, -view[VIEW_FY] * p.y * ahead * ahead, in_y, in_z);
