// Lenses with one ray per sample, from the buffer `rays`: 3 channels X, Y, Z of the padded sample grid, NaN outside of the field of
// view. A ray r intersects the splat's plane at (u, v) with (u, v, 1) D = (n_u, n_v, D) = r . (b x p, p x a, a x b),
// at depth det[a b p] / D in units of |r|: along z if rays have Z = 1, else along the ray. The forms are relative to the ray
// of the sample nearest to the centre, so that nothing cancels.
//@ intersect_functions
static inline Intersection intersect_ray(const Splat *s, vfloat ray_x, vfloat ray_y, vfloat ray_z, float half_r2
//@@ ray_intersect_parameters
) {
    vfloat x = ray_x - s->ray_x, y = ray_y - s->ray_y, z = ray_z - s->ray_z;
    vfloat nu = FMA((vfloat)s->nuz, z, FMA((vfloat)s->nuy, y, FMA((vfloat)s->nux, x, (vfloat)s->nu0)));
    vfloat nv = FMA((vfloat)s->nvz, z, FMA((vfloat)s->nvy, y, FMA((vfloat)s->nvx, x, (vfloat)s->nv0)));
    vfloat d = FMA((vfloat)s->dz, z, FMA((vfloat)s->dy, y, FMA((vfloat)s->dx, x, (vfloat)s->d0)));
    Intersection c = intersect_row(s, nu, nv, d, 0.0f, half_r2);
//@@ ray_intersect
    return c;
}
//@ camera_forms
    // any ray can be the anchor; if the centre is not imaged or its sample has no ray, use the direction of the centre
    size_t ray_stride = (width + TILE_W - 1) / TILE_W * TILE_W;
    size_t ray_plane = ray_stride * ((height + TILE_H - 1) / TILE_H * TILE_H);
    bool imaged = center_x == center_x;
    size_t ray_at = imaged ? (size_t)anchor_j * ray_stride + (size_t)anchor_i : 0;
    float anchor_ray[3] = {rays[ray_at], rays[ray_plane + ray_at], rays[2 * ray_plane + ray_at]};
    if (!(imaged && anchor_ray[0] == anchor_ray[0])) {
        real away = sqrt(dot3(p, p));
        away = away > 0 ? 1 / away : 0;
        anchor_ray[0] = (float)(p.x * away);
        anchor_ray[1] = (float)(p.y * away);
        anchor_ray[2] = (float)(p.z * away);
    }
    real3_ of_u = cross3(b, p), of_v = cross3(p, a), of_d = {unit_normal.x * su * sv, unit_normal.y * su * sv, unit_normal.z * su * sv};
    real3_ anchor = {anchor_ray[0], anchor_ray[1], anchor_ray[2]};
    real3_ k0 = {dot3(of_u, anchor), dot3(of_v, anchor), dot3(of_d, anchor)};
    real3_ kx = {of_u.x, of_v.x, of_d.x}, ky = {of_u.y, of_v.y, of_d.y}, kz = {of_u.z, of_v.z, of_d.z};
    real determinant = su * sv * offset;
//@ camera_steepest
    steepest = fmax(steepest, fmax(fabs(kz.x), fabs(kz.y)));
//@ project
    record.nuz = (blend_real)(kz.x * n_scale);
    record.nvz = (blend_real)(kz.y * n_scale);
    record.dz = (blend_real)(kz.z * facing);
    record.ray_x = anchor_ray[0];
    record.ray_y = anchor_ray[1];
    record.ray_z = anchor_ray[2];
//@ lanes_start
    size_t ray_stride = (size_t)tiles_x * TILE_W, ray_plane = ray_stride * tiles_y * TILE_H;
#define RAY(k) BLOCK_LOAD(rays + (k) * ray_plane + (y0 + TOP(block)) * ray_stride + x0 + LEFT(block), ray_stride)
//@ group_start
    size_t ray_stride = (size_t)tiles_x * TILE_W, ray_plane = ray_stride * tiles_y * TILE_H;
    float pixel_rays[3][ROWS];
    for (int row = 0; row < ROWS; row++)
        for (int k = 0; k < 3; k++) pixel_rays[k][row] = rays[k * ray_plane + (py + row) * ray_stride + px];
#define RAY(k) pixel_rays[k][row]
//@ intersect
    c = intersect_ray(&s, RAY(0), RAY(1), RAY(2), half_r2
//@@ ray_intersect_arguments
    );
//@ background_ray
    ray_x = rays[at];
    ray_y = rays[channel_stride + at];
    ray_z = rays[2 * (size_t)channel_stride + at];
    if (!(ray_x == ray_x)) return;           // outside of the field of view
//@ mask
    mask &= VMASK(c.d == c.d);               // the low-pass renders nothing where there is no ray
