// Backward pass of the projection: from gradients of a splat's record, summed over its tiles, to gradients of its mean,
// rotation, scales, opacity and colour, and of the camera. Branches are taken as in project.cl. The common factor of a
// record's affine forms (splat.cl) has no gradient, since nothing depends on it.

#define MIN_SCALE 1e-20f   // as in project.cl

//@@ camera
//@@ functions
//@@ footprint_here

//@@ struct Totals
typedef char totals_have_the_fields_of_record_gradients[sizeof(Totals) / sizeof(real) == FIELDS ? 1 : -1];

static inline real3_ add3(real3_ a, real3_ b) {
    real3_ c = {a.x + b.x, a.y + b.y, a.z + b.z};
    return c;
}

static inline real3_ scaled(real s, real3_ a) {
    real3_ b = {s * a.x, s * a.y, s * a.z};
    return b;
}

static inline real3_ rotate_to_camera(global const View *view, real3_ v) {
    global const real *r = view->rotation;
    real3_ c = {r[0] * v.x + r[1] * v.y + r[2] * v.z, r[3] * v.x + r[4] * v.y + r[5] * v.z,
                r[6] * v.x + r[7] * v.y + r[8] * v.z};
    return c;
}

static inline real3_ rotate_to_world(global const View *view, real3_ v) {
    global const real *r = view->rotation;
    real3_ c = {r[0] * v.x + r[3] * v.y + r[6] * v.z, r[1] * v.x + r[4] * v.y + r[7] * v.z,
                r[2] * v.x + r[5] * v.y + r[8] * v.z};
    return c;
}

typedef struct {            // gradients with respect to the parameters of one splat
    float mean[3], quat[4], scale[2], opacity;
    float color[3], basis[SH_COEFFICIENTS];    // with respect to coefficient k of the colour: basis[k] times `color`
    float grad2d;
    real grad_camera[10];     // contribution to the gradient of the pose, of fx, fy, cx and cy
//@@ footprint_gradient
} SplatGradient;

// Gradients of splat i; zero if it is culled. coefficients: of the spherical harmonics, `row` per splat and channel.
static inline SplatGradient splat_gradient(
    uint i, global const View *view, global const float *means, global const float *quats, global const float *scales,
    global const float *opacities, global const float *coefficients, uint row, global const Splat *splats, global const uint *keys,
    global const uint2 *windows, uint big_capacity, global const Bounds *big_bounds, int width, int height,
    global const uint *gradient_offsets, global const float *record_gradients
//@@ footprint_parameters
) {
    SplatGradient splat_grad = {{0}};
    if (keys[i] >= OUT_OF_BAND) return splat_grad;
    Totals total = {0};
    global const float *tile_gradient = record_gradients + (size_t)gradient_offsets[i] * FIELDS;
    uint tiles = tile_count(windows[i], big_capacity, big_bounds, width, height);
    for (uint tile = 0; tile < tiles; tile++, tile_gradient += FIELDS)
        for (uint field = 0; field < FIELDS; field++) ((real *)&total)[field] += tile_gradient[field];
    real3_ grad_ray = {0, 0, 0};       // with respect to the vector from the camera to the centre, in world axes
//@@ color_backward
    real grad_log = total.log_opacity;
    real w = quats[4 * i], x = quats[4 * i + 1], y = quats[4 * i + 2], z = quats[4 * i + 3];
    real s = REAL(2.0) / (w * w + x * x + y * y + z * z);
    real3_ tangent_u = {1 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)};
    real3_ tangent_v = {s * (x * y - w * z), 1 - s * (x * x + z * z), s * (y * z + w * x)};
    real3_ mean = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
    real3_ unit_a = rotate_to_camera(view, tangent_u), unit_b = rotate_to_camera(view, tangent_v);
    real3_ p = rotate_to_camera(view, mean);
    p.x += view->translation[0]; p.y += view->translation[1]; p.z += view->translation[2];
    real pz = p.z, su = fmax(scales[2 * i], MIN_SCALE), sv = fmax(scales[2 * i + 1], MIN_SCALE);
    real3_ a = scaled(su, unit_a), b = scaled(sv, unit_b);
    real offset = dot3(cross3(unit_a, unit_b), p);
//@@ footprint_projection
//@@ ellipsoid_projection

    // the forms, as in project.cl and the camera's file
    real x_offset = view->center_x - (splats[i].ax + REAL(0.5)), y_offset = view->center_y - (splats[i].ay + REAL(0.5));
    real3_ row_x = {a.x, b.x, p.x}, row_y = {a.y, b.y, p.y}, tw = {a.z, b.z, p.z};
    real3_ tu = image_row(view->focal_x, x_offset, row_x, tw), tv = image_row(view->focal_y, y_offset, row_y, tw);
    real3_ k0 = cross3(tu, tv), kx = cross3(tv, tw), ky = cross3(tw, tu);
    real steepest = fmax(fmax(fabs(kx.x), fabs(ky.x)), fmax(fabs(kx.y), fabs(ky.y)));
//@@ camera_steepest
    real scale = (offset < 0 ? -1 : 1) / steepest, n_scale = scale * REAL(0.70710678118654752440);
    real facing = fabs(offset) > (PROJECTION_FP64 ? REAL(1e-13) : REAL(1e-6)) * sqrt(dot3(p, p)) ? scale : 0;

    real3_ grad_k0 = {n_scale * total.nu0, n_scale * total.nv0, facing * total.d0};
    real3_ grad_kx = {n_scale * total.nux, n_scale * total.nvx, facing * total.dx};
    real3_ grad_ky = {n_scale * total.nuy, n_scale * total.nvy, facing * total.dy};
    real3_ grad_tu = add3(cross3(tv, grad_k0), cross3(grad_ky, tw));
    real3_ grad_tv = add3(cross3(grad_k0, tu), cross3(tw, grad_kx));
    real3_ grad_tw = add3(cross3(grad_kx, tv), cross3(tu, grad_ky));
//@@ camera_backward
    grad_tw = add3(grad_tw, add3(scaled(x_offset, grad_tu), scaled(y_offset, grad_tv)));
    real3_ grad_a = {view->focal_x * grad_tu.x, view->focal_y * grad_tv.x, grad_tw.x};
    real3_ grad_b = {view->focal_x * grad_tu.y, view->focal_y * grad_tv.y, grad_tw.y};
    real3_ grad_p = {view->focal_x * grad_tu.z, view->focal_y * grad_tv.z, grad_tw.z};
    splat_grad.grad_camera[6] = dot3(grad_tu, row_x);
    splat_grad.grad_camera[7] = dot3(grad_tv, row_y);
    splat_grad.grad_camera[8] = dot3(grad_tu, tw);
    splat_grad.grad_camera[9] = dot3(grad_tv, tw);
    // with respect to the projected centre, in half images
    real across_x = grad_tu.z * view->width, across_y = grad_tv.z * view->height;
    splat_grad.grad2d = (float)(REAL(0.5) * pz * sqrt(across_x * across_x + across_y * across_y));
//@@ disk_backward
//@@ ellipsoid_backward
    real grad_su = dot3(grad_a, unit_a), grad_sv = dot3(grad_b, unit_b);
    real3_ grad_unit_a = scaled(su, grad_a), grad_unit_b = scaled(sv, grad_b);
//@@ unit_normal_backward
//@@ footprint_backward
    const real3_ grad_motion[2] = {
        add3(cross3(p, grad_p), add3(cross3(unit_a, grad_unit_a), cross3(unit_b, grad_unit_b))),
        add3(grad_p, rotate_to_camera(view, grad_ray)),
    };
    for (int k = 0; k < 2; k++) {
        splat_grad.grad_camera[3 * k] = grad_motion[k].x;
        splat_grad.grad_camera[3 * k + 1] = grad_motion[k].y;
        splat_grad.grad_camera[3 * k + 2] = grad_motion[k].z;
    }
    real3_ grad_mean = add3(rotate_to_world(view, grad_p), grad_ray);
    real3_ grad_u = rotate_to_world(view, grad_unit_a);
    real3_ grad_v = rotate_to_world(view, grad_unit_b);
    // the tangents are 1 - s (y y + z z) etc. with s = 2 / |q|^2
    real grad_s = -grad_u.x * (y * y + z * z) + grad_u.y * (x * y + w * z) + grad_u.z * (x * z - w * y)
                + grad_v.x * (x * y - w * z) - grad_v.y * (x * x + z * z) + grad_v.z * (y * z + w * x);
    real grad_along_q = -s * grad_s;       // part along the quaternion q
    splat_grad.quat[0] = (float)(s * (grad_u.y * z - grad_u.z * y - grad_v.x * z + grad_v.z * x + grad_along_q * w));
    splat_grad.quat[1] = (float)(s * (grad_u.y * y + grad_u.z * z + grad_v.x * y - 2 * grad_v.y * x + grad_v.z * w + grad_along_q * x));
    splat_grad.quat[2] = (float)(s * (-2 * grad_u.x * y + grad_u.y * x - grad_u.z * w + grad_v.x * x + grad_v.z * z + grad_along_q * y));
    splat_grad.quat[3] = (float)(s * (-2 * grad_u.x * z + grad_u.y * w + grad_u.z * x - grad_v.x * w - 2 * grad_v.y * z + grad_v.z * y
                                       + grad_along_q * z));
    splat_grad.mean[0] = (float)grad_mean.x;
    splat_grad.mean[1] = (float)grad_mean.y;
    splat_grad.mean[2] = (float)grad_mean.z;
    splat_grad.scale[0] = scales[2 * i] >= MIN_SCALE ? (float)grad_su : 0.0f;
    splat_grad.scale[1] = scales[2 * i + 1] >= MIN_SCALE ? (float)grad_sv : 0.0f;
    splat_grad.opacity = (float)(grad_log / opacities[i]);
    return splat_grad;
}
