// Pinhole camera, OpenCV axes: row of M for an image axis, relative to an anchor coordinate on that axis, is
// focal * axis_row + (principal - anchor) * depth_row.
//@ camera
static inline real3_ image_row(real focal, real offset, real3_ axis_row, real3_ depth_row) {
    real3_ row = {focal * axis_row.x + offset * depth_row.x, focal * axis_row.y + offset * depth_row.y,
                  focal * axis_row.z + offset * depth_row.z};
    return row;
}
