// Inverse lookup table of a lens: image bounds of a region of ray directions. Two coordinates of a direction, which each lens
// defines in its file, are divided into a grid of cells. For each cell `inverse_lens_lut` stores the first and last column and row of the samples whose rays are inside; coarser grids, each of
// half the resolution, follow. The bounds are valid for arbitrary rays.
//@ camera
// Bounds of the samples whose rays are in [x0, x1] x [y0, y1] of the table; empty if there are none. numbers: low corner, cells per
// unit along x and y, cells per side, first row of this image in the table's image.
static inline Bounds lens_lut_bounds(global const real *numbers, global const short4 *map, real x0, real x1, real y0, real y1) {
    real cells = numbers[4];
    // margin of 0.02 cells for the rounding of the coordinates
    real from_x = (x0 - numbers[0]) * numbers[2] - REAL(0.02), to_x = (x1 - numbers[0]) * numbers[2] + REAL(0.02);
    real from_y = (y0 - numbers[1]) * numbers[3] - REAL(0.02), to_y = (y1 - numbers[1]) * numbers[3] + REAL(0.02);
    short4 box = (short4)(32767, -1, 32767, -1);
    if (to_x >= 0 && from_x <= cells && to_y >= 0 && from_y <= cells) {
        int last = (int)cells - 1;
        int i0 = min((int)fmax(from_x, REAL(0.0)), last), i1 = min((int)fmin(to_x, cells), last);
        int j0 = min((int)fmax(from_y, REAL(0.0)), last), j1 = min((int)fmin(to_y, cells), last);
        int side = last + 1;
        while (i1 - i0 > 5 || j1 - j0 > 5) {
            map += side * side;
            side /= 2;
            i0 /= 2; i1 /= 2; j0 /= 2; j1 /= 2;
        }
        for (int j = j0; j <= j1; j++)
            for (int i = i0; i <= i1; i++) {
                short4 cell = map[j * side + i];
                box.xz = min(box.xz, cell.xz);
                box.yw = max(box.yw, cell.yw);
            }
    }
    if (box.x > box.y) return box_bounds(1, 0, 1, 0);
    real top = numbers[5] - REAL(0.5);
    return box_bounds(box.x + REAL(0.5), box.y + REAL(0.5), box.z - top, box.w - top);
}
