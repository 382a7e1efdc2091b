// Orthographic camera, parallel rays along z: x = fx X + cx, so the last row of the projection is (0, 0, 1). D is constant, and depth
// times D is another affine form of the pixel.
//@ intersection
    vfloat z;               // depth times D, at the ray-plane intersection
//@ camera_offset
    offset = unit_normal.z;       // the visible side: the camera is infinitely far away
//@ camera_bounds
    real3_ row_x = {a.x, b.x, p.x}, row_y = {a.y, b.y, p.y}, tw = {0, 0, 1};
    real3_ tu = image_row(view->focal_x, view->center_x, row_x, tw);
    real3_ tv = image_row(view->focal_y, view->center_y, row_y, tw);
    real center_x = tu.z, center_y = tv.z;
    real3_ cu = image_row(view->focal_x, view->center_x - center_x, row_x, tw);
    real3_ cv = image_row(view->focal_y, view->center_y - center_y, row_y, tw);
    Bounds bounds = ellipse_bounds(cu, cv, tw, center_x, center_y, radius * radius);
//@ camera_forms
    tu = image_row(view->focal_x, view->center_x - anchor_x, row_x, tw);
    tv = image_row(view->focal_y, view->center_y - anchor_y, row_y, tw);
    real3_ k0 = cross3(tu, tv), kx = cross3(tv, tw), ky = cross3(tw, tu);   // (n_u, n_v, D): constant, per x, per y
    real determinant = view->focal_x * view->focal_y * su * sv * offset;
    k0.z = determinant;
//@ camera_facing
    facing = fabs(offset) > (PROJECTION_FP64 ? REAL(1e-13) : REAL(1e-6)) ? scale : 0;
//@ project
    record.z0 = (blend_real)((a.z * k0.x + b.z * k0.y + pz * k0.z) * facing);
    record.zx = (blend_real)((a.z * kx.x + b.z * kx.y) * facing);
    record.zy = (blend_real)((a.z * ky.x + b.z * ky.y) * facing);
    record.d_near = INFINITY;
    record.z_near = (blend_real)near;
//@ intersect
    c.z = FMA((vfloat)s.zy, (vfloat)y, FMA((vfloat)s.zx, x, (vfloat)s.z0));
    c.inside &= VMASK(c.z >= s.z_near * c.d);
//@ camera_attribute_depth
    depth_d = c.z;
//@ camera_lowpass_depth
        beyond_near = VMASK(c.z >= s->z_near * c.d);
//@ camera_derivative
        gx.x = view->focal_x * a.x; gx.y = view->focal_x * b.x;
        gy.x = view->focal_y * a.y; gy.y = view->focal_y * b.y;
//@ camera_box_near
        d_near = INFINITY;                   // z_near tests the near plane instead
//@ camera_ellipsoid
        towards.x = towards.y = 0; towards.z = 1;
        parallel = true;
//@ camera_image
        per_x = view->focal_x;
        per_y = view->focal_y;
        across.x = per_x * a.x; across.y = per_x * b.x; across.z = per_x * c.x;
        down.x = per_y * a.y; down.y = per_y * b.y; down.z = per_y * c.y;
