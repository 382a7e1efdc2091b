// Edges of boxes (part/box_cover.cl) whose edge functions D +- n_u, D +- n_v are affine in the sample: straight lines with one inverse gradient each.
//@ footprint_functions
static inline vfloat slab_coverage(vfloat d, vfloat n, blend_real edge_0, blend_real edge_1) {
    vfloat above = clamp(FMA(FMA((vfloat)SQRT_2, n, d), (vfloat)edge_0, (vfloat)0.5f), (vfloat)0.0f, (vfloat)1.0f);
    vfloat below = clamp(FMA(FMA((vfloat)-SQRT_2, n, d), (vfloat)edge_1, (vfloat)0.5f), (vfloat)0.0f, (vfloat)1.0f);
    return fmax(above + below - 1.0f, (vfloat)0.0f);
}
//@ footprint_intersect
    if (IS_BOX(s)) {
        c.cover = slab_coverage(c.d, nu, s->edge_u0, s->edge_u1) * slab_coverage(c.d, nv, s->edge_v0, s->edge_v1);
        c.inside = VMASK(c.cover > 0.0f) & VMASK(c.d > 0.0f) & VMASK(c.d <= s->d_near);
    }
//@ footprint_conic
    if (IS_BOX(s)) conic_h = INFINITY;
//@ functions
#define BOX_SIDES 6
#define BOX_CORNERS (4 + BOX_SIDES)
static inline real box_edge(real3_ k0, real3_ kx, real3_ ky, real facing, real sign, bool along_v, real *line) {
    real n0 = along_v ? k0.y : k0.x, nx = along_v ? kx.y : kx.x, ny = along_v ? ky.y : ky.x;
    line[1] = facing * kx.z + sign * nx;
    line[2] = facing * ky.z + sign * ny;
    real inverse = 1 / fmax(sqrt(line[1] * line[1] + line[2] * line[2]), REAL(1e-30));
    line[0] = (facing * k0.z + sign * n0) * inverse + REAL(0.5);
    line[1] *= inverse;
    line[2] *= inverse;
    return inverse;
}

// Box of the part of the image that a box can overlap: the image, clipped at lines half a sample outside of the four edges, at
// the plane's horizon and at the near plane. Forms, image and result are relative to one point. False if nothing is left.
static inline bool box_touches(real3_ k0, real3_ kx, real3_ ky, real facing, real d_near, real *box) {
    real line[3], x[BOX_CORNERS] = {box[0], box[1], box[1], box[0]}, y[BOX_CORNERS] = {box[2], box[2], box[3], box[3]};
    int count = 4;
    for (int side = 0; side < BOX_SIDES; side++) {
        if (side < 4) {
            box_edge(k0, kx, ky, facing, side & 1 ? -facing : facing, side >= 2, line);
        } else {
            real sign = side == 4 ? facing : -facing;
            line[0] = sign * k0.z + (side == 4 ? 0 : d_near);
            line[1] = sign * kx.z;
            line[2] = sign * ky.z;
        }
        real clipped_x[BOX_CORNERS], clipped_y[BOX_CORNERS];
        int clipped = 0;
        for (int k = 0; k < count; k++) {
            int next = k + 1 < count ? k + 1 : 0;
            real here = line[0] + line[1] * x[k] + line[2] * y[k], there = line[0] + line[1] * x[next] + line[2] * y[next];
            if (here >= 0 && clipped < BOX_CORNERS) {
                clipped_x[clipped] = x[k];
                clipped_y[clipped++] = y[k];
            }
            if ((here >= 0) != (there >= 0) && clipped < BOX_CORNERS) {
                real share = here / (here - there);
                clipped_x[clipped] = x[k] + share * (x[next] - x[k]);
                clipped_y[clipped++] = y[k] + share * (y[next] - y[k]);
            }
        }
        count = clipped;
        for (int k = 0; k < count; k++) x[k] = clipped_x[k], y[k] = clipped_y[k];
    }
    box[0] = box[2] = INFINITY;
    box[1] = box[3] = -INFINITY;
    for (int k = 0; k < count; k++) {
        box[0] = fmin(box[0], x[k]);
        box[1] = fmax(box[1], x[k]);
        box[2] = fmin(box[2], y[k]);
        box[3] = fmax(box[3], y[k]);
    }
    return count > 0;
}
//@ footprint_bounds
    if (BOX_HERE) {
        real3_ cu = image_row(view->focal_x, view->center_x - center_x, row_x, tw);
        real3_ cv = image_row(view->focal_y, view->center_y - center_y, row_y, tw);
        real box[4] = {-1 - center_x, view->width + 1 - center_x, -1 - center_y, view->height + 1 - center_y};
        real d_near = fabs(view->focal_x * view->focal_y * su * sv * offset) / near;
//@@ camera_box_near
        real towards_box = offset < 0 ? -1 : 1;
        if (!box_touches(cross3(cu, cv), cross3(cv, tw), cross3(tw, cu), towards_box, d_near, box)) return;
        bounds = box_bounds(center_x + box[0], center_x + box[1], center_y + box[2], center_y + box[3]);
    }
//@ project
    real edge_line[3];
    record.edge_u0 = (blend_real)box_edge(k0, kx, ky, scale, scale, false, edge_line);
    record.edge_u1 = (blend_real)box_edge(k0, kx, ky, scale, -scale, false, edge_line);
    record.edge_v0 = (blend_real)box_edge(k0, kx, ky, scale, scale, true, edge_line);
    record.edge_v1 = (blend_real)box_edge(k0, kx, ky, scale, -scale, true, edge_line);
