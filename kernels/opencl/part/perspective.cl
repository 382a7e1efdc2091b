// Bounds of a disk by perspective projection, for the pinhole and for lenses with distortion coefficients.
//@ camera_bounds
    real3_ row_x = {a.x, b.x, p.x}, row_y = {a.y, b.y, p.y}, tw = {a.z, b.z, p.z};
    real3_ tu = image_row(view->focal_x, view->center_x, row_x, tw);
    real3_ tv = image_row(view->focal_y, view->center_y, row_y, tw);
    real center_x, center_y;
    Bounds bounds;
    if (pz - reach >= near) {
        center_x = tu.z / pz;
        center_y = tv.z / pz;
        real3_ cu = image_row(view->focal_x, view->center_x - center_x, row_x, tw);
        real3_ cv = image_row(view->focal_y, view->center_y - center_y, row_y, tw);
        bounds = ellipse_bounds(cu, cv, tw, center_x, center_y, radius * radius);
#if SPLATS_PER_ITEM > 1
    } else if (!crosses_near) {
        KEY = CROSSES_NEAR;
        return;
#endif
    } else {
        real box[4];
        if (!clipped_box(tu, tv, tw, radius, near, box)) return;
        bounds = box_bounds(box[0], box[1], box[2], box[3]);
        // behind the near plane it is only the anchor
        center_x = pz >= near ? tu.z / pz : fmin(fmax(view->focal_x * p.x / near + view->center_x, REAL(0.0)), (real)view->width);
        center_y = pz >= near ? tv.z / pz : fmin(fmax(view->focal_y * p.y / near + view->center_y, REAL(0.0)), (real)view->height);
    }
