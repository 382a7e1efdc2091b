// Pinhole camera, OpenCV axes: row of M for an image axis, relative to an anchor coordinate on that axis, is
// focal * axis_row + (principal - anchor) * z_row.
//@ camera
static inline real3_ image_row(real focal, real offset, real3_ axis_row, real3_ z_row) {
    real3_ row = {focal * axis_row.x + offset * z_row.x, focal * axis_row.y + offset * z_row.y,
                  focal * axis_row.z + offset * z_row.z};
    return row;
}
