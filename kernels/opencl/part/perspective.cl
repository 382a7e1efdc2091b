// Perspective projection, shared by the pinhole and lenses. OpenCV axes: the row of M of an image axis, relative to an anchor on that
// axis, is focal * axis_row + (principal - anchor) * z_row.
//@ camera
static inline real3_ image_row(real focal, real offset, real3_ axis_row, real3_ z_row) {
    real3_ row = {focal * axis_row.x + offset * z_row.x, focal * axis_row.y + offset * z_row.y,
                  focal * axis_row.z + offset * z_row.z};
    return row;
}
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
#if BATCH > 1
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
