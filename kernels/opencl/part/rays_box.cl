// Edges of boxes (part/box_cover.cl) for lenses with one ray per sample: curves, approximated by lines within a sample. Gradients of the
// forms use the ray's derivatives with respect to the sample's position, from the buffer `ray_derivatives`: 6 channels dX/dx, dY/dx, dZ/dx, dX/dy,
// dY/dy, dZ/dy.
//@ footprint_functions
// Ramp of a form over one sample: 1 half a sample inside of the edge, 0 half a sample outside.
static inline vfloat edge_ramp(vfloat form, vfloat form_dx, vfloat form_dy) {
    vfloat steep = sqrt(fmax(FMA(form_dx, form_dx, form_dy * form_dy), (vfloat)1e-36f));
    return clamp(form / steep + 0.5f, (vfloat)0.0f, (vfloat)1.0f);
}

static inline vfloat slab_coverage(vfloat d, vfloat n, vfloat d_x, vfloat d_y, vfloat n_x, vfloat n_y) {
    const vfloat root = SQRT_2;
    vfloat above = edge_ramp(FMA(root, n, d), FMA(root, n_x, d_x), FMA(root, n_y, d_y));
    vfloat below = edge_ramp(FMA(-root, n, d), FMA(-root, n_x, d_x), FMA(-root, n_y, d_y));
    return fmax(above + below - 1.0f, (vfloat)0.0f);
}

static inline vfloat along_ray(blend_real x, blend_real y, blend_real z, vfloat to_x, vfloat to_y, vfloat to_z) {
    return FMA((vfloat)z, to_z, FMA((vfloat)y, to_y, (vfloat)x * to_x));
}
//@ ray_intersect_parameters
    , vfloat xx, vfloat yx, vfloat zx, vfloat xy, vfloat yy, vfloat zy   // derivatives of the ray with respect to x and y
//@ ray_intersect
    if (IS_BOX(s)) {
        vfloat d_x = along_ray(s->dx, s->dy, s->dz, xx, yx, zx), d_y = along_ray(s->dx, s->dy, s->dz, xy, yy, zy);
        vfloat u_x = along_ray(s->nux, s->nuy, s->nuz, xx, yx, zx), u_y = along_ray(s->nux, s->nuy, s->nuz, xy, yy, zy);
        vfloat v_x = along_ray(s->nvx, s->nvy, s->nvz, xx, yx, zx), v_y = along_ray(s->nvx, s->nvy, s->nvz, xy, yy, zy);
        c.cover = slab_coverage(d, nu, d_x, d_y, u_x, u_y) * slab_coverage(d, nv, d_x, d_y, v_x, v_y);
        c.inside = VMASK(c.cover > 0.0f) & VMASK(c.d > 0.0f) & VMASK(c.d <= s->d_near);
    }
//@ ray_intersect_arguments
                              , RAY_DERIVATIVE(0), RAY_DERIVATIVE(1), RAY_DERIVATIVE(2), RAY_DERIVATIVE(3), RAY_DERIVATIVE(4), RAY_DERIVATIVE(5)
//@ lanes_start
#define RAY_DERIVATIVE(k) BLOCK_LOAD(ray_derivatives + (k) * ray_plane + (y0 + TOP(block)) * ray_stride + x0 + LEFT(block), ray_stride)
//@ group_start
    float pixel_ray_derivatives[6][ROWS];
    for (int row = 0; row < ROWS; row++)
        for (int k = 0; k < 6; k++) pixel_ray_derivatives[k][row] = ray_derivatives[k * ray_plane + (py + row) * ray_stride + px];
#define RAY_DERIVATIVE(k) pixel_ray_derivatives[k][row]
//@ footprint_spread
    // A partly covered sample is at |u| <= 1 + |grad F| / 2 D for the forms F = D -+ n_u, likewise for v. With
    // |grad F| <= |F| max_ray_derivative (|F| of its three factors) and D >= su sv |offset| / |P|, the point P on the plane is at most
    // |p| + |u| su + |v| sv away: a linear inequality whose solution is a larger box. Where it has no solution, near the plane's
    // horizon, the bounds are the complete plane.
    real3_ box_a = a, box_b = b;
    real box_reach = reach;
    if (BOX_HERE) {
        real3_ of_u = cross3(b, p), of_v = cross3(p, a);
        real half_step = REAL(0.5) * max_ray_derivative[0] / (su * sv * fabs(offset)), far_off = sqrt(dot3(p, p));
        real wider_u = half_step * (su * sv + sqrt(dot3(of_u, of_u))), wider_v = half_step * (su * sv + sqrt(dot3(of_v, of_v)));
        real share = wider_u * su + wider_v * sv;
        bool bounded = share < REAL(0.9);
        real furthest = bounded ? far_off + (su + sv + share * far_off) / (1 - share) : 0;
        real to_u = bounded ? 1 + wider_u * furthest : REAL(1e6) * (1 + (far_off + sv) / su);
        real to_v = bounded ? 1 + wider_v * furthest : REAL(1e6) * (1 + (far_off + su) / sv);
        a.x *= to_u; a.y *= to_u; a.z *= to_u;
        b.x *= to_v; b.y *= to_v; b.z *= to_v;
        reach = radius * sqrt(a.z * a.z + b.z * b.z);
    }
//@ footprint_bounds
    a = box_a;
    b = box_b;
    reach = box_reach;
